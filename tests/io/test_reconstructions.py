"""Reconstructions of other programs by their equations, round trips, and refusals."""

import dataclasses
import json
import re
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxphoto.camera import get_parameter, parameter_names
from jaxphoto.errors import InputError
from jaxphoto.extras.formats import Project, ProjectCamera, convert, export, read_source
from jaxphoto.initial.approximate import approximate
from jaxphoto.io import read_block, write_block
from jaxphoto.report.results import assumed_pixel_words, report_title
from jaxphoto.unknowns import FREE
from tests.io.oriented_files import inside, misfits_px
from tests.io.test_exports import CAMERAS, SENSOR, fisheye, plane

RNG = np.random.default_rng(5)
ROTATIONS = Rotation.from_rotvec([[3.1, 0.02, 0.1], [0.1, 3.0, 0.3], [2.2, 2.1, 0.1]])
CENTRES = np.array([[0.5, -0.3, 8.0], [1.3, 0.4, 9.0], [-1.2, 0.1, 7.5]])
EASTING_NORTHING = np.array([500_000.0, 5_200_000, 0])
POINTS = RNG.uniform(-1.5, 1.5, (7, 3))
WIDTH, HEIGHT = 640, 480
NAMES = ["b.jpg", "a.jpg", "c.jpg"]


def seen(image):
    """x / z and y / z, x right, y down."""
    x, y, z = ROTATIONS[image].apply(POINTS - CENTRES[image]).T
    assert (z > 0).all()
    return x / z, y / z


def pixels(image, kind, f=800.0, centre=(325.5, 239.0), k=(-0.12, 0.03, -0.01, 0.002), p=(1e-3, -2e-3)):
    """Column and row, the centre of the first pixel at (0.5, 0.5), of a camera with the first of these terms."""
    x, y = seen(image)
    terms = {"none": 0, "k1": 1, "k2": 2, "k3": 3, "brown": 3, "fisheye2": 2, "fisheye": 4}[kind]
    if kind.startswith("fisheye"):
        return fisheye(x, y, f, f, *centre, (*k[:terms], *[0] * (4 - terms)))
    return plane(x, y, f, f, *centre, (*k[:terms], *[0] * (6 - terms)), p if kind == "brown" else (0, 0))


def free_of(block, camera):
    priors = block.priors.interior[camera]
    return {name for name in parameter_names(priors) if get_parameter(priors, name) == FREE}


def misfits_of(block):
    """Reprojection errors (px) of the start values; a block without points has those of the scene."""
    known = block.start.point_known.any()
    return misfits_px(block, None if known else POINTS[[int(name) - 100 for name in block.points]])


# OpenSfM ------------------------------------------------------------------------------------------------------------

OPENSFM = {
    "perspective": ("k2", {"focal": 800 / WIDTH, "k1": -0.12, "k2": 0.03}, {"c_mm", "k1", "k2"}),
    "brown": (
        "brown",
        {"focal_x": 800 / WIDTH, "focal_y": 800 / WIDTH, "c_x": 5.5 / WIDTH, "c_y": -1.0 / WIDTH}
        | {"k1": -0.12, "k2": 0.03, "k3": -0.01, "p1": 1e-3, "p2": -2e-3},
        {"c_mm", "xp_mm", "yp_mm", "k1", "k2", "k3", "p1", "p2"},
    ),
    "fisheye": ("fisheye2", {"focal": 800 / WIDTH, "k1": -0.12, "k2": 0.03}, {"c_mm", "k1", "k2"}),
}  # fmt: skip


def write_open_sfm(folder, kind="brown", change=lambda content: content, version="OPENSFM_TRACKS_VERSION_v2\n"):
    terms, camera, _ = OPENSFM[kind]
    centre = (325.5, 239.0) if kind == "brown" else (WIDTH / 2, HEIGHT / 2)
    translations = -ROTATIONS.apply(CENTRES)
    content = {
        "cameras": {"v2 one": {"projection_type": kind, "width": WIDTH, "height": HEIGHT, **camera}},
        "shots": {
            name: {"rotation": r.tolist(), "translation": t.tolist(), "camera": "v2 one", "gps_dop": 10.0}
            for name, r, t in zip(NAMES, ROTATIONS.as_rotvec(), translations, strict=True)
        },
        "points": {str(10 + k): {"color": [1, 2, 3], "coordinates": x} for k, x in enumerate(POINTS.tolist())},
    }
    folder.mkdir(exist_ok=True)
    (folder / "reconstruction.json").write_text(json.dumps(change([content])))
    lines = ["x.jpg\t10\t1\t0.1\t0.1\t1\t1\t1\t1\t-1\t-1"]
    for i, name in enumerate(NAMES):
        normalised = (pixels(i, terms, centre=centre) - [WIDTH / 2, HEIGHT / 2]) / WIDTH
        lines += [
            f"{name}\t{10 + k}\t{k}\t{x!r}\t{y!r}\t0.004\t1\t2\t3\t-1\t-1"
            for k, (x, y) in enumerate(normalised.tolist())
        ]
    (folder / "tracks.csv").write_text(version + "\n".join(lines) + "\n")
    return folder


# BlocksExchange -----------------------------------------------------------------------------------------------------

POSE = "<Pose><Rotation>{matrix}</Rotation><Center><x>{0}</x><y>{1}</y><z>{2}</z></Center></Pose>"
GROUP = """<Photogroup><Name>one</Name><ImageDimensions><Width>640</Width><Height>480</Height></ImageDimensions>
<CameraModelType>Perspective</CameraModelType>{focal}
<PrincipalPoint><x>325.0</x><y>238.5</y></PrincipalPoint>
<Distortion><K1>-0.12</K1><K2>0.03</K2><K3>-0.01</K3><P1>-0.002</P1><P2>0.001</P2></Distortion>
{photos}</Photogroup>"""


SRS = "<SpatialReferenceSystems><SRS><Id>0</Id><Definition>{}</Definition></SRS></SpatialReferenceSystems>"


def write_blocks_exchange(folder, pixels_of_focal=True, system="", change=lambda text: text):
    """P1 and P2 are Agisoft's, the second and first of OpenCV's."""
    photos = ""
    for k, name in enumerate(NAMES):
        r = ROTATIONS[k].as_matrix()
        matrix = "".join(
            f"<M_{i}{j}>{r[i, j]!r}</M_{i}{j}>".replace("np.float64", "") for i in range(3) for j in range(3)
        )
        pose = POSE.format(*CENTRES[k].tolist(), matrix=re.sub(r"[()]", "", matrix))
        photos += f"<Photo><Id>{k + 5}</Id><ImagePath>C:\\flight\\{name}</ImagePath>{pose}</Photo>"
    photos += "<Photo><Id>9</Id><ImagePath>C:\\flight\\lost.jpg</ImagePath></Photo>"
    focal = (
        "<FocalLengthPixels>800</FocalLengthPixels>"
        if pixels_of_focal
        else "<FocalLength>8</FocalLength><SensorSize>6.4</SensorSize>"
    )
    xy, ties = [(pixels(i, "brown") - 0.5).tolist() for i in range(3)], ""
    for k, (x, y, z) in enumerate(POINTS.tolist()):
        measured = "".join(
            f"<Measurement><PhotoId>{i + 5}</PhotoId><x>{xy[i][k][0]!r}</x><y>{xy[i][k][1]!r}</y></Measurement>"
            for i in range(3)
        )
        ties += f"<TiePoint><Position><x>{x!r}</x><y>{y!r}</y><z>{z!r}</z></Position>{measured}</TiePoint>\n"
    text = (
        f'<?xml version="1.0" encoding="utf-8"?>\n<BlocksExchange version="2.1">{system}<Block><Name>small</Name>'
        f"<SRSId>0</SRSId><Photogroups>{GROUP.format(focal=focal, photos=photos)}</Photogroups>"
        f"<ControlPoints><ControlPoint><Name>A</Name></ControlPoint></ControlPoints><TiePoints>{ties}</TiePoints>"
        "</Block></BlocksExchange>"
    )
    folder.mkdir(exist_ok=True)
    (folder / "block.xml").write_text(change(text))
    return folder


# Bundler ------------------------------------------------------------------------------------------------------------


def write_bundler(folder, names=True, change=lambda lines: lines):
    turn = np.array([[1.0], [-1.0], [-1.0]])
    words = lambda values: " ".join(map(repr, np.ravel(values).tolist()))  # noqa: E731
    lines = ["# Bundle file v0.3", f"4 {len(POINTS)}"]
    for k in range(3):
        r = turn * ROTATIONS[k].as_matrix()
        lines += ["800.0 -0.12 0.03", *map(words, r), words(-r @ CENTRES[k])]
    lines += ["0 0 0"] * 5
    measured = [(pixels(i, "k2", centre=(0.0, 0.0)) * [1, -1]).tolist() for i in range(3)]
    for k, x in enumerate(POINTS):
        lines += [
            words(x),
            "1 2 3",
            " ".join(["4", *(f"{i} {k} {measured[i][k][0]!r} {measured[i][k][1]!r}" for i in range(3)), "3 1 5.0 6.0"]),
        ]
    folder.mkdir(exist_ok=True)
    (folder / "bundle.out").write_text("\n".join(change(lines)) + "\n")
    if names:
        (folder / "list.txt").write_text("".join(f"{name} 0 800.0\n" for name in [*NAMES, "lost.jpg"]))
    return folder


# Pix4D --------------------------------------------------------------------------------------------------------------


def write_pix4d(folder, offset=(0.0, 0.0, 0.0), change=lambda text: text, points=lambda text: text):
    words = lambda values: " ".join(map(repr, np.ravel(values).tolist()))  # noqa: E731
    text = (
        "fileName imageWidth imageHeight\ncamera matrix K [3x3]\nradial distortion [3x1]\ntangential distortion [2x1]\n"
    )
    text += "camera position t [3x1]\ncamera rotation R [3x3]\ncamera model m = K [R|-Rt] X\n\n"
    ties = ""
    for i, name in enumerate(NAMES):
        text += f"{name} {WIDTH} {HEIGHT}\n800.0 0 325.5\n0 800.0 239.0\n0 0 1\n-0.12 0.03 -0.01\n0.001 -0.002\n"
        text += f"{words(CENTRES[i] - offset)}\n" + "".join(f"{words(row)}\n" for row in ROTATIONS[i].as_matrix())
        ties += f"{name.removesuffix('.jpg')}\n"
        ties += "".join(f"{100 + k} {words(xy)} 2.5\n" for k, xy in enumerate(pixels(i, "brown"))) + "-99\n"
    ties += "lost\n100 5.0 6.0 2.5\n-99\n"
    params = folder / "1_initial" / "params"
    params.mkdir(parents=True, exist_ok=True)
    (params / "flight_calibrated_camera_parameters.txt").write_text(change(text))
    (params / "flight_tp_pix4d.txt").write_text(points(ties))
    (params / "flight_offset.xyz").write_text(words(np.array(offset)) + "\n")
    return folder


WRITERS = {
    "opensfm": lambda folder: write_open_sfm(folder),
    "opensfm perspective": lambda folder: write_open_sfm(folder, "perspective", version=""),
    "opensfm fisheye": lambda folder: write_open_sfm(folder, "fisheye"),
    "blocksexchange": lambda folder: write_blocks_exchange(folder),
    "blocksexchange mm": lambda folder: write_blocks_exchange(folder, pixels_of_focal=False),
    "bundler": lambda folder: write_bundler(folder),
    "pix4d": lambda folder: write_pix4d(folder),
    "pix4d offset": lambda folder: write_pix4d(folder, offset=(0.25, -1.0, 3.0)),
}


@pytest.mark.filterwarnings("ignore:.*skipped")
@pytest.mark.parametrize("name", WRITERS)
def test_reprojection_errors_vanish_by_the_equations_of_the_program(tmp_path, name):
    block = read_source(WRITERS[name](tmp_path / "in"))
    assert block.images == ("a", "b", "c")
    assert len(block.points) == 7 and len(block.image_points.image) == 21
    assert np.abs(misfits_of(block)).max() < 1e-9
    np.testing.assert_allclose(block.start.unknowns.exterior.position, CENTRES[[1, 0, 2]], atol=1e-12)
    assert block.datum.kind == "inner" and block.start.image_known.all()


@pytest.mark.filterwarnings("ignore:.*skipped")
def test_a_sensor_in_millimetres_tells_the_pixel(tmp_path):
    block = read_source(write_blocks_exchange(tmp_path / "in", pixels_of_focal=False))
    assert block.sensors["one"].pixel_mm == pytest.approx(6.4 / WIDTH, rel=1e-15)
    assert float(block.start.unknowns.interior["one"].c) == pytest.approx(8.0, rel=1e-15)
    nothing = lambda text: text.replace("<SensorSize>6.4", "<SensorSize>0")  # noqa: E731
    with pytest.raises(InputError, match="pixel size 0 mm is invalid"):
        read_source(write_blocks_exchange(tmp_path / "none", pixels_of_focal=False, change=nothing))


@pytest.mark.parametrize("kind", OPENSFM)
def test_a_camera_is_free_in_what_the_program_estimates(tmp_path, kind):
    block = read_source(write_open_sfm(tmp_path / "in", kind), "opensfm")
    assert free_of(block, "v2 one") == OPENSFM[kind][2]


ROUND_TRIPS = [("opensfm", "opencv"), ("opensfm", "fisheye"), ("blocksexchange", "brown")]
PLACED = [("opensfm", "opencv", "epsg"), ("blocksexchange", "brown", "epsg")]


@pytest.mark.filterwarnings("ignore:.*fewer than two images")
@pytest.mark.parametrize(("format", "camera", "frame"), [(*each, "local") for each in ROUND_TRIPS] + PLACED)
def test_exports_round_trip(tmp_path, format, camera, frame):
    p = inside(camera, frame)
    # Pixels have no size there.
    held = dataclasses.replace(SENSOR, pixel_mm=0.001, pixel_assumed=True)
    p = p._replace(cameras={"one": ProjectCamera(SENSOR, CAMERAS[camera])})
    export(p, tmp_path / "out", format)
    block = read_source(tmp_path / "out", format)
    assert isinstance(p, Project) and block.sensors["one"] == held
    order = [block.images.index(name) for name in sorted(block.images)]
    assert order == list(range(4))
    by_name = np.argsort(np.array(p.images, object))
    np.testing.assert_allclose(
        block.start.unknowns.exterior.camera_from_object, p.exterior.camera_from_object[by_name], atol=1e-10
    )
    position = np.asarray(block.start.unknowns.exterior.position)
    if frame == "epsg":
        # Both from the centre of the earth, and in the axes of the first.
        (there, origin), (turn, own) = (f.map.geocentric_from_local() for f in (p.frame, block.frame))
        position = (position @ turn.T + own - origin) @ there
    np.testing.assert_allclose(position, p.exterior.position[by_name], atol=1e-9 if frame == "local" else 1e-6)
    assert np.abs(misfits_px(block)).max() < (1e-9 if frame == "local" else 1e-4)
    assert float(block.start.unknowns.interior["one"].c) == pytest.approx(float(CAMERAS[camera].c) / 2.4, abs=1e-12)


def test_the_largest_of_several_reconstructions_is_read_with_a_warning(tmp_path):
    small = lambda content: [{**content[0], "shots": dict(list(content[0]["shots"].items())[:1])}, *content]  # noqa: E731
    with pytest.warns(UserWarning, match="read the largest of 2 reconstructions .3 of 4 shots"):
        assert len(read_source(write_open_sfm(tmp_path / "in", change=small)).images) == 3


@pytest.mark.filterwarnings("ignore:.*skipped")
def test_blocks_exchange_on_a_map_keeps_it(tmp_path, monkeypatch):
    here = sys.modules[__name__]
    monkeypatch.setattr(here, "CENTRES", CENTRES + EASTING_NORTHING)
    monkeypatch.setattr(here, "POINTS", POINTS + EASTING_NORTHING)
    block = read_source(write_blocks_exchange(tmp_path / "in", system=SRS.format("EPSG:32633")))
    assert block.frame.code == 32633
    found = block.frame.map.map(np.asarray(block.start.unknowns.exterior.position))
    np.testing.assert_allclose(found, CENTRES[[1, 0, 2]], atol=1e-6)
    with pytest.raises(InputError, match="'a plane' is not a coordinate system"):
        read_source(write_blocks_exchange(tmp_path / "in", system=SRS.format("a plane")))


def test_a_reconstruction_without_reference_stays_local(tmp_path):
    lla = {"latitude": 0.0, "longitude": 0.0, "altitude": 0.0}
    folder = write_open_sfm(tmp_path / "in")
    (folder / "reference_lla.json").write_text(json.dumps(lla))
    assert read_source(folder).frame.kind == "local"
    (folder / "reference_lla.json").write_text(json.dumps(lla | {"latitude": 91.0}))
    with pytest.raises(InputError, match="no UTM zone at"):
        read_source(folder)
    (folder / "reference_lla.json").write_text(json.dumps(lla | {"latitude": "x"}))
    with pytest.raises(InputError, match="latitude"):
        read_source(folder)


def test_skipped_content_of_blocks_exchange_is_reported(tmp_path):
    with pytest.warns(UserWarning, match="skipped 1 (photographs without pose|control points)"):
        read_source(write_blocks_exchange(tmp_path / "in"))


def test_without_a_list_photographs_of_bundler_have_numbers(tmp_path):
    with pytest.warns(UserWarning, match=r"bundle.out: list.txt not found; photographs are numbered"):
        assert read_source(write_bundler(tmp_path / "in", names=False)).images == ("0", "1", "2")


def test_files_are_recognised_by_content_and_lists_by_the_name_of_the_bundle(tmp_path):
    for folder, name, other in (
        (write_open_sfm(tmp_path / "sfm"), "reconstruction.json", "aligned.json"),
        (write_bundler(tmp_path / "bundle"), "bundle.out", "bundle_r000.out"),
    ):
        (folder / name).rename(folder / other)
        if (folder / "list.txt").exists():
            (folder / "list.txt").rename(folder / "list_r000.out")
        assert sorted(read_source(folder / other).images) == ["a", "b", "c"]


@pytest.mark.parametrize(
    ("text", "said"),
    [("'lensmodel': 'LENSMODEL_X'", "jaxphoto camera converts"), ("EPSG:32633\n1 2 3 4 5 a.jpg g", "jaxphoto control")],
)
def test_files_for_other_commands_name_the_command(tmp_path, text, said):
    (tmp_path / "given.txt").write_text(text)
    with pytest.raises(InputError, match=said):
        read_source(tmp_path / "given.txt")


def test_a_block_keeps_its_source_and_assumed_pixel_size(tmp_path):
    convert(write_open_sfm(tmp_path / "opensfm"), tmp_path / "block")
    write_block(read_source(tmp_path / "block"), tmp_path / "again")
    block = read_source(tmp_path / "again")
    assert block.converted_from == f"opensfm: {tmp_path.name}/opensfm" and block.sensors["v2 one"].pixel_assumed
    assert report_title(block) == f"opensfm, converted from opensfm: {tmp_path.name}/opensfm"
    assert "of every camera is unknown: 0.001 mm is assumed." in assumed_pixel_words(block.sensors)
    # A pixel that is known to be of that size is not assumed.
    known = dataclasses.replace(block.sensors["v2 one"], pixel_assumed=False)
    write_block(dataclasses.replace(block, sensors={"v2 one": known}), tmp_path / "known")
    assert assumed_pixel_words(read_block(tmp_path / "known").sensors) == ""


def test_pix4d_photographs_without_camera_are_reported_and_points_intersected(tmp_path):
    with pytest.warns(UserWarning, match="1 photographs that are not in flight_calibrated.*: 'lost'"):
        block = read_source(write_pix4d(tmp_path / "in", offset=(0.25, -1.0, 3.0)))
    assert free_of(block, "0") == {"c_mm", "xp_mm", "yp_mm", "k1", "k2", "k3", "p1", "p2"}
    found = np.asarray(approximate(block).points)
    assert np.abs(found - POINTS[[int(name) - 100 for name in block.points]]).max() < 1e-6


@pytest.mark.filterwarnings("ignore:.*skipped")
def test_a_matrix_of_pix4d_itself_has_the_angles_that_it_prints(tmp_path):
    """One photograph of a project that is public: R in one file, omega, phi, kappa in another."""
    rows = (
        "-0.49632901575943477734 0.86794436424468834890 -0.01816834310427051929\n"
        "0.86649900151927328196 0.49400145706385401034 -0.07170802454019638366\n"
        "-0.05326338781351704077 -0.05133362440616233424 -0.99726018196053234366\n"
    )
    words = "".join(" ".join(map(repr, row.tolist())) + "\n" for row in ROTATIONS[0].as_matrix())
    block = read_source(write_pix4d(tmp_path / "in", change=_replaced(words, rows)))
    angles = np.rad2deg(np.asarray(block.start.unknowns.exterior.omega_phi_kappa))[block.images.index("b")]
    np.testing.assert_allclose(angles, [-2.946680, 3.053212, 119.804001], rtol=0, atol=1e-6)


def _set(path, value):
    """Changes one place of a tree of lists and names."""

    def change(content):
        place = content
        for key in path[:-1]:
            place = place[key]
        place[path[-1]] = value
        return content

    return change


def _geographic(text):
    return text.replace("<Block>", SRS.format("EPSG:4326") + "<Block>")


def _replaced(old, new):
    return lambda text: text.replace(old, new)


def _sfm(*path_and_value, **more):
    return lambda folder: write_open_sfm(folder, change=_set(*path_and_value), **more)


def _blocks(change, **more):
    return lambda folder: write_blocks_exchange(folder, change=change, **more)


def _pix4d(change=lambda text: text, **more):
    return lambda folder: write_pix4d(folder, change=change, **more)


def _bundle(change):
    return lambda folder: write_bundler(folder, change=change)


_CAMERA, _SHOT = (0, "cameras", "v2 one"), (0, "shots", "a.jpg")
REFUSED = {
    "kind": (_sfm((*_CAMERA, "projection_type"), "dual"), "'dual' is not supported"),
    "camera": (_sfm((*_SHOT, "camera"), "two"), "shots.a.jpg.*unknown camera 'two'"),
    "rotation": (_sfm((*_SHOT, "rotation"), [1, "x", 2]), "'a.jpg', rotation: .* is not 3 finite numbers"),
    "no tracks": (
        lambda f: (write_open_sfm(f) / "tracks.csv").unlink() or f / "reconstruction.json", "tracks.csv not found",
    ),
    "track": (lambda f: write_open_sfm(f, version="a.jpg\t10\t1\tx\t0\n"), "row 1: .* is not 2 finite numbers"),
    "mirror": (_blocks(lambda text: re.sub("<M_22>[^<]*<", "<M_22>2.0<", text)), "image .* is not a rotation"),
    "cut": (_blocks(lambda text: text[:-30]), "block.xml: damaged"),
    "angles": (_blocks(_geographic), "is a geographic system"),
    "axes": (
        _blocks(_replaced("<PrincipalPoint>", "<CameraOrientation>XRightYUp</CameraOrientation><PrincipalPoint>")),
        "camera one: 'XRightYUp' is not supported",
    ),
    "end": (_bundle(lambda lines: lines[:-1]), "ends within point 6"),
    # The last point but one says that it was measured ten times, which leaves two numbers for the last.
    "end amid a point": (
        _bundle(lambda lines: [*lines[:-4], f"10{lines[-4][1:]}", *lines[-3:], "0 0 0"]),
        "ends within point 6",
    ),
    "cameras that end": (_pix4d(lambda text: text[: text.rindex("\n", 0, -1)]), "29 rows, not a multiple"),
    "focal lengths": (_pix4d(_replaced("0 800.0 239", "0 801.0 239")), "two focal"),
    "of camera": (_bundle(lambda lines: [*lines[:-1], "1 17 0 1.0 1.0"]), "has a camera outside 0 to 3"),
}  # fmt: skip


@pytest.mark.filterwarnings("ignore:.*skipped")
@pytest.mark.parametrize("name", REFUSED)
def test_invalid_files_are_refused(tmp_path, name):
    write, message = REFUSED[name]
    with pytest.raises(InputError, match=message):
        read_source(write(tmp_path / "in"))
