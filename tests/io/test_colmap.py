"""COLMAP models in text and binary by COLMAP's equations, their round trip, and refusals."""

import dataclasses
import operator
import struct

import equinox as eqx
import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from jaxphoto.camera import get_parameter, parameter_names
from jaxphoto.errors import InputError
from jaxphoto.extras.formats import Project, convert, export, read_source
from jaxphoto.georeferencing import Corrections
from jaxphoto.io import read_block
from jaxphoto.io.camera_files import read_camera_file
from jaxphoto.procedures.adjust import start_of
from jaxphoto.unknowns import FREE
from tests.blocks import simulated
from tests.commands import run
from tests.io.oriented_files import misfits_px

RNG = np.random.default_rng(27)
# fx, fy, cx, cy, k1, k2, p1, p2.
PARAMS = [801.5, 803.25, 325.5, 239.0, -0.12, 0.03, 1e-3, -2e-3]
ROTATIONS = Rotation.from_rotvec([[0.0, 0, 0], [0.1, -0.3, 1.5], [3.0, 0.2, 0.1]])
TRANSLATIONS = np.array([[0.1, 0.2, 8.0], [-0.3, 0.0, 9.0], [0.2, -0.1, 7.0]])
POINTS = RNG.uniform(-1.5, 1.5, (6, 3))
RATIONAL = {f"k{k}" for k in range(1, 7)}
IDS = np.array([3, 7, 8, 20, 21, 40])
NAMES = ["b.jpg", "a.jpg", "c.jpg"]


def computed(image):
    """COLMAP's camera OPENCV, from the world to pixels."""
    fx, fy, cx, cy, k1, k2, p1, p2 = PARAMS
    x, y, z = (ROTATIONS[image].apply(POINTS) + TRANSLATIONS[image]).T
    u, v = x / z, y / z
    r2 = u * u + v * v
    q = 1 + k1 * r2 + k2 * r2 * r2
    du = u * q + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
    dv = v * q + 2 * p2 * u * v + p1 * (r2 + 2 * v * v)
    return np.column_stack([fx * du + cx, fy * dv + cy])


def features(image):
    """Features and the points they are of; one of no point first."""
    xy = np.concatenate([[[5.0, 6.0]], computed(image)])
    return xy, np.concatenate([[-1], IDS])


def quaternion(image):
    x, y, z, w = ROTATIONS[image].as_quat()
    return [w, x, y, z]


def write_text(folder, change=lambda name, lines: lines):
    files = {
        "cameras": ["# a comment", "5 OPENCV 640 480 " + " ".join(map(repr, PARAMS))],
        "images": ["# IMAGE_ID, QW, ...", "#   POINTS2D[] as (X, Y, POINT3D_ID)"],
        "points3D": ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]"],
    }
    for k, name in enumerate(NAMES):
        pose = " ".join(repr(float(v)) for v in [*quaternion(k), *TRANSLATIONS[k]])
        xy, ids = features(k)
        rows = " ".join(f"{x!r} {y!r} {i}" for (x, y), i in zip(xy.tolist(), ids, strict=True))
        files["images"] += [f"{k + 1} {pose} 5 {name}", rows]
    for j, (i, xyz) in enumerate(zip(IDS, POINTS.tolist(), strict=True), 1):
        files["points3D"].append(f"{i} {' '.join(map(repr, xyz))} 1 2 3 0.5 1 {j} 2 {j} 3 {j}")
    folder.mkdir(exist_ok=True)
    for name, lines in files.items():
        (folder / f"{name}.txt").write_text("\n".join(change(name, lines)) + "\n")
    return folder


def write_binary(folder):
    folder.mkdir(exist_ok=True)
    (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ8d", 1, 5, 4, 640, 480, *PARAMS))
    data = struct.pack("<Q", 3)
    for k, name in enumerate(NAMES):
        data += struct.pack("<I7dI", k + 1, *quaternion(k), *TRANSLATIONS[k], 5) + name.encode() + b"\0"
        xy, ids = features(k)
        data += struct.pack("<Q", len(ids))
        data += b"".join(struct.pack("<ddQ", *p, int(i) % 2**64) for p, i in zip(xy, ids, strict=True))
    (folder / "images.bin").write_bytes(data)
    data = struct.pack("<Q", len(IDS))
    for j, (i, xyz) in enumerate(zip(IDS, POINTS, strict=True), 1):
        data += struct.pack("<Q3d3BdQ6I", i, *xyz, 1, 2, 3, 0.5, 3, 1, j, 2, j, 3, j)
    (folder / "points3D.bin").write_bytes(data)
    return folder


@pytest.mark.parametrize("write", [write_text, write_binary])
def test_a_model_projects_by_the_equations_of_colmap(tmp_path, write):
    block = read_source(write(tmp_path / "model"))
    assert block.images == ("a", "b", "c")
    assert set(block.points) == {str(i) for i in IDS}
    assert len(block.image_points.point) == 18
    # c is 0.8 mm, a pixel 0.001 mm.
    assert np.abs(misfits_px(block)).max() < 1e-9
    assert block.start.image_known.all() and block.start.point_known.all()
    centres = -np.einsum("nji,nj->ni", ROTATIONS.as_matrix(), TRANSLATIONS)
    np.testing.assert_allclose(block.start.unknowns.exterior.position, centres[[1, 0, 2]], atol=1e-12)
    (priors,) = block.priors.interior.values()
    free = {name for name in parameter_names(priors) if get_parameter(priors, name) == FREE}
    assert free == {"c_mm", "xp_mm", "yp_mm", "k1", "k2", "p1", "p2", "b1"}
    assert block.datum.kind == "inner"


def test_it_becomes_a_block_folder(tmp_path):
    block = convert(write_text(tmp_path / "model"), tmp_path / "block")
    again = read_block(tmp_path / "block")
    assert again.images == block.images
    np.testing.assert_allclose(again.image_points.xy, block.image_points.xy, atol=1e-12)
    assert np.abs(misfits_px(again)).max() < 1e-6


@pytest.mark.parametrize(
    ("model", "params", "free"),
    [
        ("SIMPLE_PINHOLE", "800 320 240", set()),
        ("PINHOLE", "800 801 320 240", {"b1"}),
        ("SIMPLE_RADIAL", "800 320 240 0.1", {"k1"}),
        ("RADIAL", "800 320 240 0.1 0.01", {"k1", "k2"}),
        ("FULL_OPENCV", "800 801 320 240 .1 .01 .001 .002 .3 .4 .5 .6", {*RATIONAL, "p1", "p2", "b1"}),
    ],
)  # fmt: skip
def test_parameters_of_the_model_are_free(tmp_path, model, params, free):
    def change(name, lines):
        return [f"5 {model} 640 480 {params}"] if name == "cameras" else lines

    block = read_source(write_text(tmp_path / "model", change), "colmap")
    (priors,), (interior,) = block.priors.interior.values(), block.start.unknowns.interior.values()
    names = {name for name in parameter_names(priors) if get_parameter(priors, name) == FREE}
    assert names == free | {"c_mm", "xp_mm", "yp_mm"}
    if model == "FULL_OPENCV":
        values = [float(get_parameter(interior, n)) for n in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")]
        assert values == [0.1, 0.01, 0.001, 0.002, 0.3, 0.4, 0.5, 0.6]
    if "b1" in free:
        assert float(interior.distortion.b1) == pytest.approx(800 / 801 - 1)


def test_duplicates_in_a_model_are_used_once(tmp_path):
    """Point 41 is point 40 again by the same features; image c shows point 3 in two features; point 50 is seen once."""

    def change(name, lines):
        if name == "points3D":
            return [*lines, "41 0 0 0 1 2 3 0.5", "50 0 0 0 1 2 3 0.5"]
        if name == "images":
            for k in range(3):
                x, y, _ = lines[3 + 2 * k].split()[-3:]
                lines[3 + 2 * k] += f" {x} {y} 41"
            lines[7] += " 9.0 9.0 3 11.0 11.0 50"
        return lines

    folder = write_text(tmp_path / "model", change)
    with pytest.warns(UserWarning, match=r"4 duplicate measurement\(s\) and 1 point"):
        block = read_source(folder)
    assert set(block.points) == {str(i) for i in IDS}
    assert len(block.image_points.point) == 18
    # Which of two features of one point is right is not known: one of them is kept.
    assert np.sum(np.abs(misfits_px(block)).max(axis=1) > 1e-9) <= 1


def spoil(file, row, text):
    def change(name, lines):
        if name == file:
            lines[row] = text
        return lines

    return change


@pytest.mark.parametrize(
    "change",
    [
        spoil("cameras", 1, "5 OPENCV 640 480 800 800"),
        spoil("cameras", 1, "6 SIMPLE_PINHOLE 640 480 800 320 240"),
        spoil("cameras", 0, "5 PINHOLE 640 480 800 800 320 240"),
        spoil("images", 4, "3 1 0 0 0 0 0 0 5 b.jpg"),
        spoil("points3D", 0, "3 0 0 0"),
        spoil("images", 2, "1 1 0 0 x 0 0 0 5 b.jpg"),
        spoil("images", 3, "1.0 2.0 99"),
    ],
)  # fmt: skip
def test_invalid_models_are_refused(tmp_path, change):
    with pytest.raises(InputError, match="damaged"):
        read_source(write_text(tmp_path / "model", change), "colmap")


@pytest.mark.parametrize("file", ["images", "points3D"])
def test_a_binary_file_that_ends_early(tmp_path, file):
    path = write_binary(tmp_path / "model") / f"{file}.bin"
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(InputError, match="damaged"):
        read_source(tmp_path / "model")


def test_a_folder_without_a_file_of_the_model(tmp_path):
    folder = write_text(tmp_path / "model")
    (folder / "points3D.txt").unlink()
    with pytest.raises(InputError, match=": 0 files of colmap"):
        read_source(folder, "colmap")


# Written ----------------------------------------------------------------------------------------------------


def write_colmap_model(block, folder, unknowns=None, format="colmap"):
    values = start_of(block) if unknowns is None else unknowns
    return export(Project.of_block(block, values), folder, format).cameras


def same_block(a, b):
    """Image points (px), orientations and points of both, whatever the sizes of their pixels."""
    assert a.images == b.images and len(a.points) == len(b.points)
    px = [x.sensors[x.image_camera[0]].px_from_mm(x.image_points.xy) for x in (a, b)]
    np.testing.assert_allclose(*px, rtol=0, atol=1e-9)
    for where in ("exterior.position", "exterior.camera_from_object", "points"):
        values = [operator.attrgetter(where)(x.start.unknowns) for x in (a, b)]
        np.testing.assert_allclose(*values, rtol=0, atol=1e-9)


@pytest.mark.parametrize("write", [write_text, write_binary])
def test_a_model_that_is_written_is_the_model_that_was_read(tmp_path, write):
    block = read_source(write(tmp_path / "model"))
    write_colmap_model(block, tmp_path / "binary", format="colmap-binary")
    binary = read_source(tmp_path / "binary")
    same_block(binary, block)
    conversions = write_colmap_model(block, tmp_path / "again")
    assert [c.max_px for c in conversions.values()] == [0.0]
    again = read_source(tmp_path / "again")
    same_block(again, block)
    assert again.points == block.points
    same = [x.start.unknowns.interior["5"] for x in (again, block)]
    values = [[float(get_parameter(i, n)) for n in parameter_names(i)] for i in same]
    np.testing.assert_allclose(*values, rtol=1e-13, atol=1e-16)
    assert "5 OPENCV 640 480 801.5" in (tmp_path / "again" / "cameras.txt").read_text()
    # Written anew in its own place.
    write_colmap_model(again, tmp_path / "again")
    same_block(read_source(tmp_path / "again"), block)


def test_a_block_of_another_distortion_keeps_its_bundles(tmp_path):
    """Brown's camera is fitted, and told so; points without approximate values are intersected first."""
    made, truth = simulated("cross")
    known = eqx.tree_at(lambda b: b.start.unknowns, made, truth)
    places = lambda b: (b.start.unknowns.points, b.start.point_known)  # noqa: E731
    bare = eqx.tree_at(places, known, (np.zeros_like(truth.points), np.zeros(len(made.points), bool)))
    for name, block, unknowns in (("given", bare, truth), ("found", bare, None)):
        (conversion,) = write_colmap_model(block, tmp_path / name, unknowns).values()
        assert 0 < conversion.rms_px <= conversion.max_px < 0.05
        again = read_source(tmp_path / name)
        assert again.images == made.images
        assert {int(point) for point in again.points} == set(range(1, len(made.points) + 1))
        number = np.array([int(point) for point in again.points])[again.image_points.point]
        theirs = misfits_px(again)[np.lexsort((number, again.image_points.image))]
        ours = misfits_px(known)[np.lexsort((known.image_points.point, known.image_points.image))]
        if unknowns is not None:
            np.testing.assert_allclose(theirs, ours, atol=1.5 * conversion.max_px)
        # With noise of half a pixel, intersected points fit no worse than the true ones.
        assert np.sqrt(np.mean(theirs**2)) < 1.1 * np.sqrt(np.mean(ours**2))


@pytest.mark.parametrize("format", ["colmap", "colmap-binary"])
def test_points_and_tracks_of_a_written_model_agree(tmp_path, format):
    write_colmap_model(read_source(write_text(tmp_path / "model")), tmp_path / "again", format=format)
    again = pycolmap.Reconstruction(str(tmp_path / "again"))
    assert again.num_images() == 3 and again.num_points3D() == 6
    assert again.compute_num_observations() == 18
    # By its own projection: what the file says of errors is that they are not known.
    again.update_point_3d_errors()
    assert all(0 <= point.error < 1e-9 for point in again.points3D.values())


def test_models_that_cannot_be_written(tmp_path):
    block = read_source(write_text(tmp_path / "model"))
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.txt").write_text("years of work")
    with pytest.raises(InputError, match="was not written by jaxphoto"):
        write_colmap_model(block, tmp_path / "other")
    with pytest.raises(InputError, match="is a file: give a folder"):
        write_colmap_model(block, tmp_path / "other" / "thesis.txt")
    terms = lambda b: (b.start.unknowns.interior["5"].distortion.k1, b.start.unknowns.interior["5"].distortion.b2)  # noqa: E731
    folding = eqx.tree_at(terms, block, (np.array(-9.0), np.array(0.1)))
    with pytest.raises(InputError, match=r"camera 5 cannot be written as colmap: .* is not invertible"):
        write_colmap_model(folding, tmp_path / "new")
    assert not (tmp_path / "new").exists()
    curved = dataclasses.replace(block, corrections=Corrections(curvature=True))
    with pytest.warns(UserWarning, match="colmap does not support earth curvature"):
        write_colmap_model(curved, tmp_path / "curved")


def test_the_command_converts_there_and_back(tmp_path, monkeypatch, capsys):
    model = write_text(tmp_path / "model")
    assert run(monkeypatch, capsys, "convert", model, tmp_path / "block")[0] == 0
    code, said, _ = run(monkeypatch, capsys, "convert", tmp_path / "block", tmp_path / "back", "--to", "colmap")
    assert code == 0
    assert "camera 5: the conversion is exact" in said
    same_block(read_source(tmp_path / "back"), read_source(model))
    for out, to, message in (
        (tmp_path / "block", "colmap", "is or contains the input"),
        (tmp_path / "new", "colmop", "--to colmop: unknown format"),
    ):
        code, _, error = run(monkeypatch, capsys, "convert", tmp_path / "block", out, "--to", to)
        assert (code, message in error) == (2, True)


@pytest.mark.parametrize("name", ["frame.0001", "left/a_b.JPG", "d.dng"])
def test_only_endings_of_photographs_are_taken_off(tmp_path, name):
    def change(file, lines):
        return [line.replace("a.jpg", name) for line in lines] if file == "images" else lines

    folder = write_text(tmp_path / "model", change)
    assert name.removesuffix(".JPG").removesuffix(".dng") in read_source(folder).images


def test_models_that_are_not_opencv_s_are_refused_by_name(tmp_path):
    change = spoil("cameras", 1, "5 FOV 640 480 800 800 320 240 0.9")
    for read in (read_source, read_camera_file):
        with pytest.raises(InputError, match="model FOV of camera 5 is not supported; use one of SIMPLE_PINHOLE"):
            read(write_text(tmp_path / "model", change))


def test_a_binary_camera_file_is_a_camera_file(tmp_path):
    both = [read_camera_file(write(tmp_path / write.__name__)) for write in (write_text, write_binary)]
    assert both[0].interior.c == both[1].interior.c
    assert both[1].name == "5"
