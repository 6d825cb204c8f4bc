"""Files spoilt at random, seeded, for the readers: each is read as it stands or refused in one sentence.

`READERS` lists what is read. A new reader is one entry there; `tests/io/test_mutations.py` then spoils its files a few
hundred times, and `benchmarks/mutations.py` as often as it is asked to, each reader in a process of its own.
"""

import dataclasses
import functools
import json
import re
import shutil
import struct
import tempfile
import time
import traceback
import warnings
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from PIL import Image

from jaxphoto.camera import ImageMotion, InteriorOrientation, OpenCv, RollingShutter
from jaxphoto.errors import JaxphotoError
from jaxphoto.extras.formats import export, read_control, read_source, write_camera_file
from jaxphoto.extras.photos import read_grey
from jaxphoto.io import clouds, read_block, read_recipe, write_block
from jaxphoto.io.camera_files import read_camera_file
from jaxphoto.io.conditions import read_conditions
from jaxphoto.io.draws_folder import DrawsFolder
from jaxphoto.io.exposures import read_exposures
from jaxphoto.io.input_hashes import read_inputs
from jaxphoto.io.kept_pieces import KeptPieces
from jaxphoto.io.photograph_metadata import drone_record, xmp_fields
from jaxphoto.io.photographs import photographs
from jaxphoto.io.result_folder import adjusted_block, photograph_files
from jaxphoto.io.toml import toml_text
from jaxphoto.io.trajectory import Records, read_records, write_flight_csv, write_sbet
from jaxphoto.procedures.control.surveyed import places, system_of
from jaxphoto.unknowns import FIXED, FREE, Weighted
from tests import sound_files
from tests.io import control_files, oriented_files, test_bal, test_colmap, test_reconstructions
from tests.io import test_cameras as cameras
from tests.io import test_robotics_cameras as robotics
from tests.io import test_surfaces as surfaces
from tests.io.conftest import FILES
from tests.simulation import test_changing_cameras as changing_cameras
from tests.simulation import test_relative_poses, test_rig
from tests.simulation.small import RECIPES, changed

Files = dict[str, bytes]
SLOWEST_S = 10.0
"""Of the processor: a file of any content is read or refused in it, with a shape that is compiled for anew."""
MOST_MB = 1000.0
"""And with so much memory beyond what was used before."""
# A sentence about one place; what it quotes is cut.
_LONGEST = 1500
# Bytes of a spoilt file: what takes long in it takes long by its form, not by its size.
_LARGEST = 3_000_000
# No control characters: they would be commands to a terminal.
_CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f]")
_EXAMPLES = Path(__file__).resolve().parents[1] / "examples"

NUMBERS = (
    "1e999", "-1e999", "nan", "NaN", "inf", "-inf", "0", "-0.0", "-1", "1e308", "1e-320", "1e30", "9" * 30, "9" * 400,
    "9" * 5000, "0." + "3" * 400, "1_000", "1,5", "0x1F", "1e", "--1", "\u0661\u0662", "1e5000000", "2147483648",
    "18446744073709551616", "true", "\u22121.5", "1.2.3", "",
)  # fmt: skip
"""What stands in place of a number."""
TEXTS = (
    "", " ", "#", "\0", "\x1b[31m", "\x1b]0;title\x07", "\u202e", "\ufeff", "\ud7ff", "[/red]", "[bold]", "$\\frac{1$",
    "=cmd|' /C calc'!A0", "../../etc/passwd", "/dev/zero", "/dev/null", "<script>", "&amp;", '"', "'", '""', "\\", "{",
    "}", "[", "]", "%s", "{0}", "default", "x" * 200_000, '"' + "y" * 200_000 + '"', "[" * 3000, "{a=" * 3000,
    "a." * 3000, "," * 20_000, ";" * 20_000, " " * 200_000, "\t", "\r", "\n", "<a>" * 3000, "(" * 3000, "-" * 3000,
)  # fmt: skip
"""What stands in place of a word, or between two."""
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[^\s,;=\[\]{}<>\"']+")


class Reader(NamedTuple):
    """A reader and sound files for it."""

    files: Callable[[], Files]
    """The sound files by their names, below one folder."""
    read: Callable[[Path], object]
    """Reads from that folder."""
    spoilt: tuple[str, ...] = ()
    """The files that are spoilt; all where none are named."""


class Finding(NamedTuple):
    """What a reader did that it must not do."""

    reader: str
    seed: int
    what: str
    detail: str


def text(**files: str) -> Callable[[], Files]:
    """Files of text by name; `__` in a name stands for a point."""
    return lambda: {name.replace("__", "."): content.encode() for name, content in files.items()}


def written_by(write: Callable[[Path], object]) -> Callable[[], Files]:
    """The files that `write` leaves in the folder that it is given."""

    def files() -> Files:
        with tempfile.TemporaryDirectory() as folder:
            write(Path(folder))
            paths = sorted(path for path in Path(folder).rglob("*") if path.is_file())
            return {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}

    return files


def _flight() -> Records:
    t = np.arange(50) * 0.5
    position = np.stack([5 * t - 50, 0.1 * t**2, 100 + np.sin(t)], axis=1)
    angles = np.stack([np.sin(t), np.cos(t), 90 - t], axis=1)
    given = np.full((len(t), 3), 0.02)
    return Records("flight.csv", t, position, False, angles, given, given)


def _sbet(folder: Path) -> None:
    values = np.zeros((12, 17))
    values[:, 0], values[:, 1], values[:, 2], values[:, 3] = np.arange(12), 0.8, 0.1, 500.0
    write_sbet(values, folder / "flight.sbet")


def _flown_block(folder: Path) -> None:
    for name, content in FILES.items():
        if name not in ("stations.csv", "attitudes.csv"):
            (folder / name).write_text(content, encoding="utf-8")
    toml = FILES["block.toml"].replace("[sigmas]", '[trajectory]\nfile = "flight.csv"\nmax_gap_s = 2.0\n\n[sigmas]')
    (folder / "block.toml").write_text(toml, encoding="utf-8")
    write_flight_csv(_flight(), folder / "flight.csv")


def _map_block(folder: Path) -> None:
    for name, content in FILES.items():
        (folder / name).write_text(content, encoding="utf-8")
    toml = FILES["block.toml"].replace('kind = "local"', 'kind = "epsg"\ncode = 32722\nvertical = "ellipsoidal"')
    (folder / "block.toml").write_text(toml, encoding="utf-8")
    for name in ("images.csv", "control_points.csv", "stations.csv", "object_points.csv"):
        header, *rows = FILES[name].splitlines()
        at = header.split(",").index("X_m")
        moved = [row.split(",") for row in rows]
        for cells in moved:
            for axis, offset in ((at, 580_000.0), (at + 1, 7_220_000.0)):
                cells[axis] = repr(float(cells[axis]) + offset) if cells[axis] else ""
        (folder / name).write_text("\n".join([header, *map(",".join, moved)]) + "\n", encoding="utf-8")


def _camera(name: str, **options) -> Callable[[Path], object]:
    return lambda folder: read_camera_file(folder / name, **options)


def _joint_block(folder: Path) -> None:
    """With surfaces, a scanner, and rows that covariances join."""
    for name, content in FILES.items():
        (folder / name).write_text(content, encoding="utf-8")
    toml = FILES["block.toml"].replace("[datum]", surfaces.SCANNER + "[datum]")
    (folder / "block.toml").write_text(toml, encoding="utf-8")
    (folder / "surfaces.csv").write_text(surfaces.HEAD + surfaces.ROWS, encoding="utf-8")
    joined = "set,image,axis,value_m\n1,c,0,20.0\n1,c,1,0.5\n2,c,2,100.5\n"
    (folder / "correlated_stations.csv").write_text(joined, encoding="utf-8")
    matrix = "set,a,b,covariance_m2\n1,1,1,0.01\n1,2,1,0.002\n1,2,2,0.02\n2,1,1,0.05\n"
    (folder / "correlated_stations_covariance.csv").write_text(matrix, encoding="utf-8")


_SETTINGS = {"seed": 1, "sigma": "0.1", "versions": {"jaxphoto": "0"}}


def _results(folder: Path) -> None:
    """Of the small block: a flight of one part with what it notes of its photographs."""
    (folder / "block").mkdir()
    (folder / "result").mkdir()
    for name, content in FILES.items():
        (folder / "block" / name).write_text(content, encoding="utf-8")
    camera = {"width_px": 400, "height_px": 300, "pixel_mm": 0.01, "distortion": "brown"}
    summary = {"converged": True, "cameras": {"kodak": camera}, "block": "../block"}
    values = {"c_mm": 5.01} | dict.fromkeys(("xp_mm", "yp_mm", "k1", "k2", "k3", "p1", "p2", "b1", "b2"), 0.0)
    interior = "".join(f"kodak,{name},{value},,\n" for name, value in values.items())
    tables = {
        "summary.json": json.dumps(summary),
        "interior.csv": "camera,parameter,value,sigma,significant\n" + interior,
        "exterior.csv": "image,X_m,Y_m,Z_m,omega_deg,phi_deg,kappa_deg\n"
        + "".join(f"{name},{k}.5,0.25,100.0,0.5,-0.25,{k}0.0\n" for k, name in enumerate("abc")),
        "object_points.csv": "point,X_m,Y_m,Z_m,n_images\n" + "".join(f"p{k},{k}.0,2.0,3.0,3\n" for k in range(1, 5)),
    }
    for name, content in tables.items():
        (folder / "result" / name).write_text(content, encoding="utf-8")
    (folder / "summary.json").write_text(json.dumps({"parts": [{"result": "result", "block": "block"}]}))
    (folder / "photographs.csv").write_text("image,file\na,a.jpg\nb,b b.jpg\nc,c.tif\n")


def _read_results(folder: Path) -> object:
    block = adjusted_block(folder)
    return photograph_files(block.images, (), folder)


def _draws(folder: Path) -> None:
    run = DrawsFolder(folder, _SETTINGS, 30, 10)
    for k in range(2):
        run.write_part(k, pd.DataFrame({"draw": np.arange(10), "converged": [True] * 10, "kodak.c_mm": np.ones(10)}))


def _read_draws(folder: Path) -> object:
    run = DrawsFolder(folder, _SETTINGS, 30, 10)
    return run.next_part, run.columns(), run.read(["converged", "kodak.c_mm"])


def _piece(folder: Path) -> None:
    KeptPieces(folder).write("a", xy_mm=np.arange(20.0).reshape(10, 2), feature=np.arange(10))


def _recipe(name: str) -> Reader:
    return Reader(
        lambda: {"recipe.toml": (RECIPES / f"{name}.toml").read_bytes()},
        lambda folder: read_recipe(folder / "recipe.toml"),
    )


def _open_cv(suffix: str) -> Reader:
    """As OpenCV writes a camera."""
    return Reader(
        written_by(lambda folder: write_camera_file(folder / f"a{suffix}", cameras.SENSOR, _OPEN_CV, "opencv")),
        _camera(f"a{suffix}"),
    )


_OPEN_CV = InteriorOrientation(35.0, 0.1, -0.2, OpenCv(k1=-0.2, k2=0.1, p1=1e-3, p2=-2e-3, k3=0.01))
SUMMARY = (
    '{"cameras": {"nadir": {"width_px": 4500, "height_px": 3000, "pixel_mm": 0.008, "distortion": "smac", '
    '"sign": "add"}}}'
)


def _cloud(kind: str) -> Callable[[Path], object]:
    return lambda folder: clouds.read_cloud(folder / f"a.{kind}")


def _drone_record(path: Path) -> object:
    return drone_record(xmp_fields(path.read_bytes()))


def _picture(kind: str) -> Callable[[Path], object]:
    return lambda folder: read_grey(folder / f"a.{kind}")


def _control(folder: Path, marks: Path | None = None) -> object:
    """Points and marks, and the places of the points."""
    read = read_control(folder / "a", marks)
    return places(read.points, system_of(read.points.system, "a"), 4326) if read.points.system else read


_SHUTTER = b"""
[shutters.kodak]
readout_ms = 20.0
readout = { sigma_ms = 5.0 }
velocity_m_per_s = 0.3
rate_deg_per_s = 0.3
truth = { readout_ms = 30.0 }
"""


def _warm_block(folder: Path) -> None:
    """With temperatures of photographs beside the block."""
    for name, content in FILES.items():
        (folder / name).write_text(content, encoding="utf-8")
    rates = "[unknowns.thermal_rates.kodak]\nc_rate = { sigma_mm_per_K = 1e-3 }\n"
    top = "reference_temperature_c = 20.0\n" + FILES["block.toml"].replace("[datum]", rates + "[datum]")
    (folder / "block.toml").write_text(top, encoding="utf-8")
    rows = "".join(f"{name},{name}.jpg,{'0' * 64},True,1{k}.5\n" for k, name in enumerate("abc"))
    (folder / "conditions.csv").write_text("image,file,sha256,used,lens_temperature_c\n" + rows)


def _rig_recipe(folder: Path) -> None:
    """With all that changes cameras, and a rig."""
    changing = changing_cameras.RATES | changing_cameras.THERMAL | changing_cameras.STRIPS | changing_cameras.SPLINE
    (folder / "recipe.toml").write_text(toml_text(changed(test_rig.RIG | changing)), encoding="utf-8")


def _rolling_block(folder: Path) -> None:
    block = read_block(_EXAMPLES / "cross_block")
    motion = ImageMotion(np.array([0.0, 50.0, 0.0]), np.zeros(3))
    more = {"shutters": {"kodak": RollingShutter(np.array(30.0))}, "motions": dict.fromkeys(block.images[:3], motion)}
    known = ImageMotion(Weighted(motion.velocity, np.ones(3)), FIXED)
    priors = {"shutters": {"kodak": RollingShutter(FREE)}, "motions": dict.fromkeys(block.images[:3], known)}
    start = dataclasses.replace(block.start, unknowns=dataclasses.replace(block.start.unknowns, more=more))
    write_block(dataclasses.replace(block, start=start, priors=dataclasses.replace(block.priors, more=priors)), folder)


def _photograph(folder: Path) -> None:
    exif = Image.Exif()
    exif.get_ifd(0x8769).update({0x9003: "2024:05:01 10:00:03", 0x9291: "25"})
    Image.new("RGB", (64, 48)).save(folder / "a.jpg", exif=exif)


READERS: dict[str, Reader] = {
    "block": Reader(lambda: {name: content.encode() for name, content in FILES.items()}, read_block),
    "block-map": Reader(written_by(_map_block), read_block),
    "block-flight": Reader(written_by(_flown_block), read_block),
    "trajectory-csv": Reader(
        written_by(lambda folder: write_flight_csv(_flight(), folder / "flight.csv")),
        lambda folder: read_records(folder / "flight.csv"),
    ),
    "trajectory-sbet": Reader(written_by(_sbet), lambda folder: read_records(folder / "flight.sbet")),
    "recipe": Reader(
        lambda: {"recipe.toml": (_EXAMPLES / "recipe.toml").read_bytes()},
        lambda folder: read_recipe(folder / "recipe.toml"),
    ),
    "results": Reader(
        written_by(_results),
        _read_results,
        (
            "summary.json",
            "photographs.csv",
            *(f"result/{n}" for n in ("summary.json", "exterior.csv", "object_points.csv")),
        ),
    ),
    "recipe-shutter": Reader(
        lambda: {"recipe.toml": (_EXAMPLES / "recipe.toml").read_bytes() + _SHUTTER},
        lambda folder: read_recipe(folder / "recipe.toml"),
    ),
    "block-shutter": Reader(written_by(_rolling_block), read_block),
    "recipe-rig": Reader(written_by(_rig_recipe), lambda folder: read_recipe(folder / "recipe.toml")),
    "block-rig": Reader(
        written_by(lambda folder: write_block(test_rig.flown().block, folder)),
        read_block,
        ("block.toml", "rig_places.csv", "rig_turns.csv"),
    ),
    "block-relative": Reader(
        written_by(lambda folder: write_block(test_relative_poses.flown().block, folder)),
        read_block,
        ("relative_positions.csv", "relative_attitudes.csv"),
    ),
    "block-warm": Reader(written_by(_warm_block), read_block, ("block.toml", "images.csv", "conditions.csv")),
    "photograph": Reader(written_by(_photograph), lambda folder: photographs([folder / "a.jpg"])),
    "camera-opencv": Reader(text(a__yml=cameras.OPENCV), _camera("a.yml")),
    "recipe-flight": _recipe("001"),
    "recipe-convergent": _recipe("002"),
    "recipe-lidar": _recipe("004"),
    "kept-piece": Reader(written_by(_piece), lambda folder: KeptPieces(folder).read("a")),
    "draws": Reader(written_by(_draws), _read_draws),
    "block-joint": Reader(written_by(_joint_block), read_block),
    "camera-opencv-xml": _open_cv(".xml"),
    "camera-opencv-json": _open_cv(".json"),
    "camera-colmap-bin": Reader(
        written_by(
            lambda folder: (folder / "cameras.bin").write_bytes(
                struct.pack("<QIiQQ8d", 1, 3, 4, 3072, 2304, 2560.0, 2561.0, 1536.0, 1152.0, -0.02, 0.01, 1e-3, -7e-4)
            )
        ),
        _camera("cameras.bin"),
    ),
    "camera-mrcal": Reader(text(a__cameramodel=robotics.mrcal("OPENCV8", robotics.RATIONAL)), _camera("a.cameramodel")),
    "camera-kalibr": Reader(text(a__yaml=robotics.KALIBR), _camera("a.yaml", camera="cam1")),
    "camera-agisoft": Reader(text(a__xml=cameras.AGISOFT), _camera("a.xml")),
    "camera-colmap": Reader(text(cameras__txt=cameras.COLMAP), _camera("cameras.txt", camera="5")),
    "camera-smac": Reader(text(a__txt=cameras.SMAC), _camera("a.txt")),
    "camera-smac-torn": Reader(text(a__txt=cameras.SMAC_TORN), _camera("a.txt")),
    "camera-toml": Reader(text(a__toml=cameras.TOML), _camera("a.toml")),
    "camera-results": Reader(
        text(interior__csv=cameras.INTERIOR, correlation__csv=cameras.CORRELATION, summary__json=SUMMARY), _camera("")
    ),
    "conditions": Reader(
        text(
            conditions__csv="image,file,sha256,used,time,serial,exposure_s\n"
            + f"a,a.jpg,{'0' * 64},True,2025-03-14 09:26:53,42,0.001\nb,b.jpg,{'1' * 64},False,,,\n"
        ),
        lambda folder: read_conditions(folder / "conditions.csv"),
    ),
    "inputs": Reader(
        text(inputs__csv=f"file,n_bytes,sha256\nblock.toml,488,{'a' * 64}\n"),
        lambda folder: read_inputs(folder / "inputs.csv"),
    ),
    "aicon": Reader(text(**sound_files.AICON), lambda folder: read_source(folder, "aicon")),
    "bal": Reader(text(problem__txt="\n".join(test_bal.lines_of())), lambda folder: read_source(folder, "bal")),
    "colmap-text": Reader(written_by(test_colmap.write_text), lambda folder: read_source(folder, "colmap")),
    "colmap-binary": Reader(written_by(test_colmap.write_binary), lambda folder: read_source(folder, "colmap")),
    **{
        name: Reader(written_by(write), lambda folder, name=name: read_source(folder, name))
        for name, write in (
            ("opensfm", test_reconstructions.write_open_sfm),
            ("openmvg", test_reconstructions.write_open_mvg),
            ("blocksexchange", test_reconstructions.write_blocks_exchange),
            ("bundler", test_reconstructions.write_bundler),
            ("pix4d", test_reconstructions.write_pix4d),
            ("metashape", oriented_files.write_metashape),
            ("texts", oriented_files.write_angles),
            ("nerfstudio", oriented_files.write_nerfstudio),
            ("orthority", oriented_files.write_orthority),
        )
    },
    "metashape-beside": Reader(
        written_by(oriented_files.write_metashape_beside),
        lambda folder: read_source(folder, "metashape"),
        ("image_points.csv", "markers.xml"),
    ),
    "texts-bingo": Reader(written_by(oriented_files.write_bingo), lambda folder: read_source(folder, "texts")),
    "texts-patb": Reader(written_by(oriented_files.write_patb), lambda folder: read_source(folder, "texts")),
    "dbat": Reader(text(**sound_files.DBAT), lambda folder: read_source(folder, "dbat")),
    "photomodeler": Reader(text(**sound_files.PHOTOMODELER), lambda folder: read_source(folder, "photomodeler")),
    "control-gcp-list": Reader(text(a=control_files.GCP_LIST), _control),
    "control-metashape": Reader(text(a=control_files.MARKERS), _control),
    "control-geojson": Reader(text(a=control_files.GEO_JSON), _control),
    "control-geopackage": Reader(
        written_by(lambda folder: export(oriented_files.inside("opencv"), folder, "geopackage")),
        lambda folder: read_control(folder / "photographs.gpkg"),
        ("photographs.gpkg",),
    ),
    "control-reference": Reader(text(a=control_files.REFERENCE), _control),
    "control-bingo": Reader(text(a=control_files.GEOIN), _control),
    "control-pix4d": Reader(
        text(a=control_files.PIX4D, b=control_files.PIX4D_MARKS),
        lambda folder: _control(folder, folder / "b"),
    ),
    "control-own": Reader(
        text(a=control_files.OWN, b=control_files.OWN_MARKS),
        lambda folder: _control(folder, folder / "b"),
    ),
    "exposures-marks": Reader(text(a__MRK=sound_files.MARKS), lambda folder: read_exposures(folder / "a.MRK")),
    "exposures-pos": Reader(text(a__pos=sound_files.POS), lambda folder: read_exposures(folder / "a.pos")),
    "exposures-table": Reader(
        text(a__csv=sound_files.EXPOSURES), lambda folder: read_exposures(folder / "a.csv", 32633)
    ),
    "exposures-geo-txt": Reader(text(geo__txt=sound_files.GEO_TXT), lambda folder: read_exposures(folder / "geo.txt")),
    "exposures-reference": Reader(text(a__csv=sound_files.REFERENCE), lambda folder: read_exposures(folder / "a.csv")),
    "exposures-pospac": Reader(text(eo__txt=sound_files.POSPAC), lambda folder: read_exposures(folder / "eo.txt")),
    "photograph-xmp": Reader(text(a__xmp=sound_files.XMP), lambda folder: _drone_record(folder / "a.xmp")),
    "cloud-ply-text": Reader(sound_files.ply_text, lambda folder: clouds.read_cloud(folder / "a.ply")),
    **{f"cloud-{kind}": Reader(partial(sound_files.cloud, kind), _cloud(kind)) for kind in ("csv", "ply", "las")},
    **{f"picture-{kind}": Reader(partial(sound_files.picture, kind), _picture(kind)) for kind in ("jpg", "png", "tif")},
}
"""The readers by name."""


@functools.cache
def sound(reader: str) -> Files:
    """The sound files of a reader."""
    return READERS[reader].files()


def spoilt(reader: str, seed: int) -> Files:
    """The files of a reader, one of them spoilt."""
    rng = np.random.default_rng((zlib.crc32(reader.encode()), seed))
    files = dict(sound(reader))
    name = str(rng.choice(sorted(READERS[reader].spoilt or files)))
    content = files[name]
    for _ in range(1 + rng.integers(3)):
        content = _WAYS[rng.integers(len(_WAYS))](content, rng)[:_LARGEST]
    return files | {name: content}


def tried(reader: str, seed: int, folder: Path) -> list[Finding]:
    """Spoil the files of a reader, read them, and say what it did that it must not do."""
    shutil.rmtree(folder, ignore_errors=True)
    for name, content in spoilt(reader, seed).items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    found: list[tuple[str, str]] = []
    said: list[str] = []
    # Of the processor: others may keep it busy, and a reader that only waits is seen by the script.
    began, before = time.process_time(), peak_mb(anew=True)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            READERS[reader].read(folder)
        except JaxphotoError as error:
            said.append(str(error))
        except Exception:
            found.append(("traceback", traceback.format_exc(limit=-4)))
    seconds, more = time.process_time() - began, peak_mb() - before
    said += [str(w.message) for w in caught if issubclass(w.category, UserWarning)]
    found += [
        ("warning", f"{w.filename}:{w.lineno}: {w.message}") for w in caught if issubclass(w.category, RuntimeWarning)
    ]
    found += [("message", message[:300]) for message in said if len(message) > _LONGEST or _CONTROL.search(message)]
    if seconds > SLOWEST_S:
        found.append(("slow", f"{seconds:.1f} s"))
    if more > MOST_MB:
        found.append(("memory", f"{more:.0f} MB"))
    return [Finding(reader, seed, *what) for what in found]


def peak_mb(*, anew: bool = False) -> float:
    """The most memory (MB) that this process has had resident, `anew` from now on; 0 where that is not told."""
    try:
        if anew:
            Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
        lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024
    except OSError:
        return 0.0


# Ways to spoil -----------------------------------------------------------------------------------------------


def _span(content: bytes, rng: np.random.Generator, longest: int = 200) -> tuple[int, int]:
    """Begin and end of a piece."""
    begin = int(rng.integers(len(content) + 1))
    return begin, min(len(content), begin + int(rng.integers(1, longest)))


def _byte(content: bytes, rng: np.random.Generator) -> bytes:
    begin, _ = _span(content, rng)
    return content[:begin] + bytes([rng.integers(256)]) + content[begin + 1 :]


def _bit(content: bytes, rng: np.random.Generator) -> bytes:
    if not content:
        return content
    at = int(rng.integers(len(content)))
    return content[:at] + bytes([content[at] ^ (1 << int(rng.integers(8)))]) + content[at + 1 :]


def _deleted(content: bytes, rng: np.random.Generator) -> bytes:
    begin, end = _span(content, rng)
    return content[:begin] + content[end:]


def _repeated(content: bytes, rng: np.random.Generator) -> bytes:
    begin, end = _span(content, rng)
    return content[:begin] + content[begin:end] * int(rng.choice([2, 3, 500])) + content[end:]


def _cut(content: bytes, rng: np.random.Generator) -> bytes:
    return content[: rng.integers(len(content) + 1)]


def _moved(content: bytes, rng: np.random.Generator) -> bytes:
    begin, end = _span(content, rng)
    rest = content[:begin] + content[end:]
    at = int(rng.integers(len(rest) + 1))
    return rest[:at] + content[begin:end] + rest[at:]


def _lines(content: bytes, rng: np.random.Generator) -> bytes:
    """Two lines change places, or one stands there more often, or not at all."""
    lines = content.split(b"\n")
    i, j = rng.integers(len(lines), size=2)
    kind = rng.integers(4)
    if kind == 0:
        lines[i], lines[j] = lines[j], lines[i]
    elif kind == 1:
        lines.insert(j, lines[i])
    elif kind == 2:
        lines[i : i + 1] = [lines[i]] * 2000
    else:
        del lines[i]
    return b"\n".join(lines)


def _replaced(content: bytes, rng: np.random.Generator, pattern: re.Pattern, others: tuple[str, ...]) -> bytes:
    found = list(pattern.finditer(content))
    if not found:
        return content
    match, other = found[rng.integers(len(found))], others[rng.integers(len(others))]
    return content[: match.start()] + other.encode() + content[match.end() :]


def _number(content: bytes, rng: np.random.Generator) -> bytes:
    return _replaced(content, rng, _NUMBER, NUMBERS)


def _word(content: bytes, rng: np.random.Generator) -> bytes:
    return _replaced(content, rng, _WORD, TEXTS)


def _inserted(content: bytes, rng: np.random.Generator) -> bytes:
    begin, _ = _span(content, rng)
    return content[:begin] + TEXTS[rng.integers(len(TEXTS))].encode() + content[begin:]


def _exchanged(content: bytes, rng: np.random.Generator) -> bytes:
    """A word in place of another of the same file."""
    words = sorted(set(_WORD.findall(content[:100_000])))
    return (
        _replaced(content, rng, _WORD, (words[rng.integers(len(words))].decode("utf-8", "replace"),))
        if words
        else content
    )


def _binary_number(content: bytes, rng: np.random.Generator) -> bytes:
    """Eight bytes, or four, that are an extreme number."""
    kind, values = [
        ("<f8", [np.nan, np.inf, -np.inf, 1e308, -1e300, 5e-324, 0.0, -1.0]),
        ("<i8", [-1, 0, 2**63 - 1, -(2**63), 2**32, 10**9]),
        ("<i4", [-1, 0, 2**31 - 1, -(2**31), 10**9]),
    ][rng.integers(3)]
    new = np.array([values[rng.integers(len(values))]], kind).tobytes()
    at = int(rng.integers(len(content) + 1)) // len(new) * len(new)
    return content[:at] + new + content[at + len(new) :]


_WAYS = (
    _byte, _bit, _deleted, _repeated, _cut, _moved, _lines, _number, _number, _number, _word, _word, _inserted,
    _exchanged, _binary_number,
)  # fmt: skip
