"""Write clouds as LAS, LAZ, CSV or PLY, atomically."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxphoto.block import Frame
from jaxphoto.cloud import Cloud
from jaxphoto.errors import InputError
from jaxphoto.io.clouds.cloud_reader import SUFFIXES, open_source
from jaxphoto.io.clouds.cloud_source import CHUNK
from jaxphoto.io.clouds.coordinate_system import Placement
from jaxphoto.io.clouds.tables import write_csv, write_ply
from jaxphoto.writing import whole_file

_LAS = (".las", ".laz")


def write_cloud(
    cloud: Cloud,
    path: str | Path,
    *,
    like: str | Path | None = None,
    frame: Frame | None = None,
    epsg: int | None = None,
    unit: str | None = None,
) -> None:
    """Write `cloud`, whose coordinates are in `frame`, as .las, .laz, .csv or .ply.

    `like`: the LAS or LAZ file from which the whole cloud was read (with `epsg` and `unit`). It is copied with its
    system, units, scale, other dimensions and withheld points; only coordinates are replaced. Without `like`,
    coordinates are written in the map system of `frame`, or in metres: LAS 1.4 to the millimetre, CSV and PLY in double
    precision.

    Raises OSError if writing fails, and InputError for an unsupported file name, or if `like` has a different number of
    points.
    """
    path = Path(path)
    suffix = _suffix(path)
    if like is not None:
        _write_like(cloud, path, Path(like), frame, epsg, unit)
        return
    map_frame = frame if frame is not None and frame.kind == "epsg" else None

    def parts() -> Iterator[tuple[Cloud, np.ndarray]]:
        for begin in range(0, len(cloud), CHUNK):
            part = cloud.take(np.arange(begin, min(begin + CHUNK, len(cloud))))
            yield part, part.xyz if map_frame is None else map_frame.map.map(part.xyz)

    with whole_file(path) as work:
        if suffix in _LAS:
            from jaxphoto.io.clouds.las import write_las

            write_las(parts, work, map_frame)
        else:
            (write_csv if suffix == ".csv" else write_ply)(parts(), len(cloud), work)


def rewrite_cloud(
    source: str | Path,
    path: str | Path,
    moved: Callable[[Cloud], Float[np.ndarray, "n 3"]],
    *,
    frame: Frame | None = None,
    epsg: int | None = None,
    unit: str | None = None,
) -> int:
    """Copy cloud file `source` to `path` with new coordinates; return the number of unmoved points.

    Both files have the same format. `moved` receives each part as in `read_cloud`, including noise and withheld points,
    and returns X, Y, Z (m) in the same `frame`. System and units of `source` are retained. LAS and LAZ retain all other
    dimensions, CSV and PLY the fields of `Cloud`. Memory is bounded by one part. Withheld points are not moved if they
    are outside the area of the frame's system, or if `moved` returns NaN.

    Raises OSError if writing fails, and the errors of `read_cloud` and `moved`.
    """
    source, path = Path(source), Path(path)
    suffix, cloud = _suffix(path), open_source(source, epsg, unit)
    if suffix != source.suffix.lower() and not {suffix, source.suffix.lower()} <= set(_LAS):
        raise InputError(f"{path.name} cannot be written like {source.name}: both must be files of one kind")
    placement = Placement(cloud.name, cloud.system, frame)
    stay = 0

    def coordinates(part: Cloud) -> np.ndarray:
        nonlocal stay
        if part.withheld is None or not part.withheld.any():
            return placement.file(moved(placement.placed(part)))
        inside = ~part.withheld
        inside[part.withheld] = np.isfinite(placement.frame(part.xyz[part.withheld])).all(axis=1)
        index, xyz = np.flatnonzero(inside), np.array(part.xyz)
        new = moved(placement.placed(part.take(index)))
        lost = np.isnan(new).any(axis=1) & part.withheld[index]
        xyz[index[~lost]] = placement.file(new[~lost])
        stay += len(part) - len(index) + int(lost.sum())
        return xyz

    with whole_file(path) as work:
        if suffix in _LAS:
            from jaxphoto.io.clouds.las import rewrite_las

            rewrite_las(source, work, coordinates)
        else:
            parts = ((part, coordinates(part)) for part in cloud.chunks())
            (write_csv if suffix == ".csv" else write_ply)(parts, cloud.count, work)
    return stay


def _write_like(cloud: Cloud, path: Path, like: Path, frame: Frame | None, epsg: int | None, unit: str | None) -> None:
    count = sum(map(len, open_source(like, epsg, unit).chunks()))
    if count != len(cloud):
        raise InputError(
            f"{path.name} cannot be written like {like.name}: the cloud has {len(cloud)} points, that file {count}; "
            "read the file as a whole"
        )
    done = 0

    def coordinates(part: Cloud) -> np.ndarray:
        nonlocal done
        xyz = np.full(part.xyz.shape, np.nan)
        read = np.flatnonzero(~part.withheld) if part.withheld is not None else np.arange(len(part))
        xyz[read] = cloud.xyz[done : done + len(read)]
        done += len(read)
        return xyz

    rewrite_cloud(like, path, coordinates, frame=frame, epsg=epsg, unit=unit)


def _suffix(path: Path) -> str:
    """Return the file name extension. Raises InputError for formats that cannot be written."""
    if path.name.lower().endswith(".copc.laz"):
        raise InputError(f"{path.name}: COPC is read only; name a .laz file, and convert it (pdal translate, untwine)")
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"{path.name} is not a point cloud; supported are {', '.join(SUFFIXES)}")
    return path.suffix.lower()
