"""Adjusted photographs -> a COLMAP model: cameras, images and points3D, as text or binary.

Coordinates, rotations and image points come back exactly to rounding. COLMAP knows no observations but image points:
standard deviations, control, stations and what is free stay behind. Cameras have COLMAP's models already.
Source: the documentation of COLMAP, "Output format".
"""

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np
import scipy

from jaxphoto.io.cameras.colmap import ColmapCamera, cameras_bytes, cameras_text, colmap_camera
from jaxphoto.io.colmap.model import FILES
from jaxphoto.io.exports.adjusted_photographs import AdjustedPhotographs, downwards, numbered, translations

_IMAGES = "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n# POINTS2D[] as (X, Y, POINT3D_ID)\n"
_POINTS = "# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"
# Colour and mean error of a point, which nobody knows here.
_COLOUR, _ERROR = (0, 0, 0), -1


class _Image(NamedTuple):
    """A record of images: its id, quaternion (w first) and translation, camera, file and features of points."""

    id: int
    pose: list[float]
    camera: int
    name: str
    xy: np.ndarray
    points: np.ndarray


class _Point(NamedTuple):
    """A record of points3D with its track: rows of image id and feature."""

    id: int
    xyz: list[float]
    track: np.ndarray


class _Model(NamedTuple):
    cameras: dict[int, ColmapCamera]
    images: list[_Image]
    points: list[_Point]


def write_text_model(photographs: AdjustedPhotographs, folder: Path) -> None:
    """Write cameras.txt, images.txt and points3D.txt into `folder`.

    An image has the name of its file; ids of cameras and points that are numbers stay, others are counted from 1.
    """
    model = _model(photographs)
    texts = cameras_text(model.cameras), _images_text(model.images), _points_text(model.points)
    for name, text in zip(FILES, texts, strict=True):
        (folder / f"{name}.txt").write_text(text, encoding="utf-8")


def write_binary_model(photographs: AdjustedPhotographs, folder: Path) -> None:
    """Write cameras.bin, images.bin and points3D.bin into `folder`, with the content of `write_text_model`."""
    model = _model(photographs)
    contents = cameras_bytes(model.cameras), _images_bytes(model.images), _points_bytes(model.points)
    for name, content in zip(FILES, contents, strict=True):
        (folder / f"{name}.bin").write_bytes(content)


def _model(photographs: AdjustedPhotographs) -> _Model:
    p = photographs
    camera_ids, point_ids = numbered(tuple(p.cameras)), np.array(list(numbered(p.points).values()), int)
    rotations = downwards(p.exterior)
    poses = np.hstack(
        [
            scipy.spatial.transform.Rotation.from_matrix(rotations).as_quat()[:, [3, 0, 1, 2]],
            translations(rotations, p.exterior),
        ]
    )
    images, feature = [], p.place_in_image
    for i, rows in enumerate(p.rows_of_images):
        camera = camera_ids[p.image_camera[i]]
        record = _Image(i + 1, poses[i].tolist(), camera, p.files[i], p.column_row[rows], point_ids[p.point[rows]])
        images.append(record)
    points = [
        _Point(int(identifier), xyz, np.stack([p.image[rows] + 1, feature[rows]], axis=1))
        for identifier, xyz, rows in zip(point_ids, p.xyz.tolist(), p.rows_of_points, strict=True)
        if len(rows)
    ]
    return _Model({camera_ids[name]: colmap_camera(*camera) for name, camera in p.cameras.items()}, images, points)


def _images_text(images: list[_Image]) -> str:
    lines = []
    for image in images:
        lines.append(f"{image.id} {' '.join(map(repr, image.pose))} {image.camera} {image.name}")
        features = zip(image.xy.tolist(), image.points.tolist(), strict=True)
        lines.append(" ".join(f"{column!r} {row!r} {point}" for (column, row), point in features))
    return _IMAGES + "\n".join(lines) + "\n"


def _points_text(points: list[_Point]) -> str:
    rest = " ".join(map(str, (*_COLOUR, _ERROR)))
    lines = (" ".join([str(p.id), *map(repr, p.xyz), rest, *map(str, p.track.ravel().tolist())]) for p in points)
    return _POINTS + "".join(line + "\n" for line in lines)


def _images_bytes(images: list[_Image]) -> bytes:
    parts = [struct.pack("<Q", len(images))]
    for image in images:
        features = np.zeros(len(image.points), [("xy", "<f8", 2), ("point", "<u8")])
        features["xy"], features["point"] = image.xy, image.points
        head = struct.pack("<I7dI", image.id, *image.pose, image.camera)
        parts += [head, image.name.encode() + b"\0", struct.pack("<Q", len(features)), features.tobytes()]
    return b"".join(parts)


def _points_bytes(points: list[_Point]) -> bytes:
    parts = [struct.pack("<Q", len(points))]
    for p in points:
        parts += [
            struct.pack("<Q3d3BdQ", p.id, *p.xyz, *_COLOUR, _ERROR, len(p.track)),
            p.track.astype("<u4").tobytes(),
        ]
    return b"".join(parts)
