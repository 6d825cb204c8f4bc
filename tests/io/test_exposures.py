"""Files of exposures: read, matched to photographs, reduced to the camera; each invalid input costs one message."""

import re
import shutil
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pyproj
import pytest
from PIL import Image

from jaxphoto.errors import InputError
from jaxphoto.georeferencing.camera_attitude import CameraAttitude, level_from_belly
from jaxphoto.georeferencing.map_frame import MapFrame
from jaxphoto.georeferencing.recorded_positions import FIX_SIGMA_M, LEAP_SECONDS, WEEK_S, Gps, Taken, moved
from jaxphoto.io.exposures import located, read_exposures, with_exposures
from jaxphoto.io.photographs import Photograph, valid_photographs
from jaxphoto.io.trajectory import write_sbet

ORIGIN = Gps(55.7, 13.2, 100.0)
BEGIN_S = 2200 * WEEK_S + 200_000.0
ARM = np.array([-0.02, 0.05, -0.19])


class Flight:
    """Two strips of five exposures: times (GPS), cameras; the antenna is `-ARM` away, east, north, up."""

    def __init__(self, n=10):
        rng = np.random.default_rng(6)
        interval = np.where(np.arange(1, n) % 5 == 0, 20.0, 2.5) + rng.normal(0, 0.1, n - 1)
        self.time = BEGIN_S + np.concatenate([[0], np.cumsum(interval)])
        strip, along = np.divmod(np.arange(n), 5)
        at = np.stack([strip * 40.0, np.where(strip % 2, 4 - along, along) * 20.0, 0.3 * along], axis=1)
        self.camera = [moved(ORIGIN, p) for p in at]

    def mark(self, k, number=None, shift_s=0.0, sigma=0.012, flag=50):
        gps, t = self.camera[k], self.time[k] + shift_s
        east, north, up = 1000 * ARM
        return (
            f"{number or k + 1}\t{t % WEEK_S:.6f}\t[{int(t // WEEK_S)}]\t {north:.0f},N\t {east:.0f},E\t {-up:.0f},V\t"
            f"{gps.latitude_deg:.8f},Lat\t{gps.longitude_deg:.8f},Lon\t{gps.altitude_m:.3f},Ellh\t"
            f"{sigma:.6f}, {2 * sigma:.6f}, {3 * sigma:.6f}\t{flag},Q\n"
        )

    def photograph(self, k, ahead_s=7200.0, told=False, **more):
        clock = np.floor(self.time[k] - LEAP_SECONDS + ahead_s)
        gps = self.camera[k]._replace(altitude_m=57.0)
        own = Photograph(
            f"DJI_{k + 1:04}", Path("a.jpg"), 400, 300, gps=gps, taken=Taken(clock, 1.0, ahead_s if told else None)
        )
        return own._replace(**more)

    def antenna(self, k):
        return moved(self.camera[k], -ARM)


FLIGHT = Flight()
ALL = range(10)


def pos_line(time_s, gps, q=1):
    at = datetime(1980, 1, 6) + timedelta(seconds=time_s)
    place = f"{gps.latitude_deg:.9f} {gps.longitude_deg:.9f} {gps.altitude_m:.4f}"
    return f"{at:%Y/%m/%d %H:%M:%S.%f}  {place}   {q}  12  0.0061 0.0072 0.0143 0 0 0 0.00 9.9\n"


HEAD = "% program   : RTKPOST\n% (lat/lon/height=WGS84/ellipsoidal,Q=1:fix)\n%  GPST  latitude(deg) longitude(deg)\n"


def written(path, text):
    path.write_text(text)
    return path


def same(gps, other, within_m=1e-3):
    scale = np.array([1.1e5, 0.6e5, 1.0])
    d = scale * (np.array(gps[:3], float) - np.array(other[:3], float))
    return float(np.abs(d).max()) < within_m


def test_marks_are_read(tmp_path):
    found = read_exposures(written(tmp_path / "a.MRK", FLIGHT.mark(3, number=7)))
    assert found.sequence.tolist() == [7] and found.time_s[0] == pytest.approx(FLIGHT.time[3], abs=1e-5)
    gps = found.gps(0)
    assert same(gps, FLIGHT.camera[3]) and gps.sigma_m == (0.024, 0.012, 0.036)
    assert (gps.fix, gps.heights) == ("fixed", "ellipsoid")
    np.testing.assert_allclose(found.camera_from_antenna_m, [ARM], atol=1e-9)
    nothing = read_exposures(written(tmp_path / "a.MRK", FLIGHT.mark(3, flag=0)))
    assert nothing.gps(0) is None
    with pytest.raises(InputError, match=r"row 2: '2.* is not a time mark"):
        located([FLIGHT.photograph(3)], [], [written(tmp_path / "b.MRK", FLIGHT.mark(0) + FLIGHT.mark(1)[:60])])


def test_marks_by_number_with_fewer_and_more_lines_than_photographs(tmp_path):
    file = read_exposures(written(tmp_path / "a.MRK", "".join(FLIGHT.mark(k) for k in (0, 1, 3, 4, 5, 6, 7, 8, 9))))
    taken, said = with_exposures([FLIGHT.photograph(k) for k in ALL if k not in (5, 9)], [file])
    assert [same(p.gps, FLIGHT.camera[int(p.name[4:]) - 1]) for p in taken] == [k != 2 for k in range(8)]
    assert taken[2].gps.altitude_m == 57.0
    assert "7 of 8 photographs by number, 7 fixed" in said[0] and "none for DJI_0003; 2 of its exposures" in said[0]


def test_marks_without_their_number_in_the_names_are_not_used(tmp_path):
    file = read_exposures(written(tmp_path / "a.MRK", "".join(FLIGHT.mark(k) for k in ALL)))
    own = [FLIGHT.photograph(k, name=f"IMG{k}") for k in ALL]
    taken, said = with_exposures(own, [file])
    assert taken == own and "no photograph matches by number; not used" in said[0]


def test_marks_of_two_flights_that_both_count_from_one(tmp_path):
    """Each file is beside its photographs."""
    both, photographs = Flight(20), []
    for name, first in (("a", 0), ("b", 10)):
        (tmp_path / name).mkdir()
        written(tmp_path / name / f"{name}.MRK", "".join(both.mark(first + k, k + 1) for k in ALL))
        for k in ALL:
            path = tmp_path / name / f"{name}_{k + 1:04}.jpg"
            photographs.append(both.photograph(first + k, name=path.stem, path=path))
    taken, said = located(photographs, [tmp_path / "a", tmp_path / "b"])
    assert all(same(p.gps, c) for p, c in zip(taken, both.camera, strict=True)), said


def test_marks_of_another_flight_are_not_used(tmp_path):
    file = read_exposures(written(tmp_path / "a.MRK", "".join(FLIGHT.mark(k) for k in ALL)))
    away = [FLIGHT.photograph(k, gps=moved(FLIGHT.camera[k], np.array([900.0, 0, 0]))) for k in ALL]
    taken, said = with_exposures(away, [file])
    assert taken == away and "another flight" in said[0] and "not used" in said[0]


def test_events_of_the_antenna_are_brought_to_the_camera_by_the_arms_of_the_marks(tmp_path):
    marks = read_exposures(written(tmp_path / "a.MRK", "".join(FLIGHT.mark(k, sigma=1.1, flag=16) for k in ALL)))
    # One event is missing, and one is surplus.
    lines = "".join(pos_line(FLIGHT.time[k], FLIGHT.antenna(k), 2 if k == 1 else 1) for k in ALL if k != 4)
    events = read_exposures(written(tmp_path / "a_events.pos", HEAD + pos_line(BEGIN_S - 30, ORIGIN) + lines))
    taken, said = with_exposures([FLIGHT.photograph(k) for k in ALL], [events, marks])
    assert all(same(p.gps, c, 2e-3) for p, c in zip(taken, FLIGHT.camera, strict=True))
    assert [p.gps.fix for p in taken] == ["fixed", "float", *["fixed"] * 2, "single", *["fixed"] * 5]
    assert taken[0].gps.sigma_m == (0.0072, 0.0061, 0.0143)
    assert "9 of 10 photographs by time, 8 fixed, 1 float" in said[1]
    assert "none for DJI_0005; 1 of its exposures without a photograph; lever arms of 9 are those of the" in said[1]


def test_events_without_times_of_the_photographs_are_matched_in_order(tmp_path):
    lines = [pos_line(FLIGHT.time[k], FLIGHT.camera[k]) for k in ALL]
    own = [FLIGHT.photograph(k) for k in reversed(ALL)]
    events = read_exposures(written(tmp_path / "a_events.pos", HEAD + "".join(lines)))
    taken, said = with_exposures(own, [events])
    assert all(same(p.gps, FLIGHT.camera[k]) for p, k in zip(taken, reversed(ALL), strict=True)), said
    fewer = read_exposures(written(tmp_path / "a_events.pos", HEAD + "".join(lines[1:])))
    taken, said = with_exposures(own, [fewer])
    assert taken == own and "9 events for 10 photographs, whose GPS times are unknown; not used" in said[0]


@pytest.mark.parametrize("clock", ["GPST", "UTC", "JST", "week"])
def test_a_trajectory_is_interpolated_at_the_marks(tmp_path, clock):
    marks = read_exposures(written(tmp_path / "a.MRK", "".join(FLIGHT.mark(k) for k in ALL)))
    at = np.arange(FLIGHT.time[0] - 2, FLIGHT.time[-2] + 0.5, 0.2)
    behind = {"UTC": LEAP_SECONDS, "JST": LEAP_SECONDS - 32400}.get(clock, 0.0)
    middle = np.array([g[:3] for g in (FLIGHT.antenna(k) for k in ALL)])
    place = np.stack([np.interp(at, FLIGHT.time, middle[:, k]) for k in range(3)], axis=1)
    lines = [pos_line(t - behind, Gps(*p)) for t, p in zip(at, place, strict=True)]
    if clock == "week":
        rest = [line.split(maxsplit=2)[2] for line in lines]
        lines = [f"{t // WEEK_S:.0f} {t % WEEK_S:.3f} {part}" for t, part in zip(at, rest, strict=True)]
    gap = (at > FLIGHT.time[3] - 0.5) & (at < FLIGHT.time[3] + 0.5)
    text = HEAD.replace("GPST", clock if clock != "week" else "GPST") + "".join(np.array(lines)[~gap])
    track = read_exposures(written(tmp_path / "a.pos", text))
    taken, said = with_exposures([FLIGHT.photograph(k) for k in ALL], [track, marks])
    # Straight between exposures: the spline rounds the corners by centimetres.
    assert all(same(p.gps, c, 0.25) for p, c in zip(taken, FLIGHT.camera, strict=True))
    assert "positions of 8 of 10 photographs by interpolation" in said[1]
    assert "none for DJI_0004, DJI_0010" in said[1]


def test_a_trajectory_without_exact_times_is_not_used(tmp_path):
    lines = "".join(pos_line(BEGIN_S + 0.2 * k, ORIGIN) for k in range(100))
    file = read_exposures(written(tmp_path / "a.pos", HEAD + lines))
    assert (
        "needs the GPS time of every exposure to the millisecond"
        in with_exposures([FLIGHT.photograph(k) for k in ALL], [file]).sentences[0]
    )
    exact = [FLIGHT.photograph(k, taken=Taken(FLIGHT.time[k] - 18 + 9e6, 1e-6, 0.0)) for k in ALL]
    assert "no photograph matches by interpolation" in with_exposures(exact, [file]).sentences[0]


def test_a_lever_arm_that_is_given_turns_with_the_aircraft(tmp_path):
    arm = (0.02, -0.1, 0.3)
    yaw = 70.0
    turn = level_from_belly(yaw, 3.0, -2.0)
    lines = "".join(pos_line(FLIGHT.time[k], moved(FLIGHT.camera[k], turn @ np.array(arm))) for k in ALL)
    events = read_exposures(written(tmp_path / "a.pos", HEAD + lines))
    flown = [FLIGHT.photograph(k, told=True, aircraft_deg=(-2.0, 3.0, yaw)) for k in ALL]
    taken, said = with_exposures(flown, [events], arm)
    assert all(same(p.gps, c) for p, c in zip(taken, FLIGHT.camera, strict=True)) and "10 is as given" in said[0]
    fixed = [p._replace(aircraft_deg=None, attitude=CameraAttitude(turn)) for p in flown]
    assert all(same(p.gps, c) for p, c in zip(with_exposures(fixed, [events], arm)[0], FLIGHT.camera, strict=True))
    plain = [p._replace(aircraft_deg=None) for p in flown]
    assert "no aircraft attitude to rotate it" in with_exposures(plain, [events], arm).sentences[0]
    assert "give it by --lever-arm" in with_exposures(plain, [events]).sentences[0]
    own = [p._replace(gps=moved(c, turn @ np.array(arm))) for p, c in zip(flown, FLIGHT.camera, strict=True)]
    taken, said = with_exposures(own, [], arm)
    assert all(same(p.gps, c) for p, c in zip(taken, FLIGHT.camera, strict=True)) and "applied to 10" in said[0]


def test_an_sbet_gives_positions_and_attitudes(tmp_path):
    at = np.arange(FLIGHT.time[0] - 2, FLIGHT.time[-1] + 2, 0.05)
    values = np.zeros((len(at), 17))
    place = np.array([g[:3] for g in FLIGHT.camera])
    track = np.stack([np.interp(at, FLIGHT.time, place[:, k]) for k in range(3)], axis=1)
    values[:, 0], values[:, 1:3], values[:, 3] = at % WEEK_S, np.deg2rad(track[:, :2]), track[:, 2]
    values[:, 7], values[:, 9], values[:, 10] = 0.01, 1.3, 0.2
    write_sbet(values, tmp_path / "flight.sbet")
    (tmp_path / "x.MRK").write_text("".join(FLIGHT.mark(k) for k in ALL))
    photographs = [FLIGHT.photograph(k, path=tmp_path / "a.jpg") for k in ALL]
    taken, said = located(photographs, [tmp_path])
    assert all(same(p.gps, c, 0.1) for p, c in zip(taken, FLIGHT.camera, strict=True))
    expected = level_from_belly(np.degrees(1.1), 0.0, np.degrees(0.01))
    np.testing.assert_allclose(taken[0].attitude.level_from_camera, expected, atol=1e-9)
    assert any("flight.sbet: positions of 10 of 10 photographs by interpolation" in s for s in said)
    assert any("10 are positions of the IMU, the lever arm is unknown" in s for s in said)
    assert taken[0].gps.stated_sigma_m == FIX_SIGMA_M["integrated"] and any("10 integrated" in s for s in said)
    # Events of the antenna tell the times as well; their file comes after that of the trajectory.
    (tmp_path / "x.MRK").unlink()
    lines = [pos_line(FLIGHT.time[k], FLIGHT.antenna(k)) for k in ALL]
    (tmp_path / "z_events.pos").write_text(HEAD + "".join(lines))
    taken, said = located(photographs, [tmp_path], heights="ellipsoid")
    assert all(p.gps.fix == "integrated" for p in taken), said
    assert all(same(p.gps, c, 0.1) for p, c in zip(taken, FLIGHT.camera, strict=True))


def test_unused_lever_arm_is_reported(tmp_path):
    file = read_exposures(written(tmp_path / "a.MRK", "".join(FLIGHT.mark(k) for k in ALL)))
    photographs = [FLIGHT.photograph(k) for k in ALL]
    arm = (0.0, 0.1, 0.2)
    said = with_exposures(photographs, [file], arm).sentences
    assert "the lever arm is not used: positions of time marks and tables are those of the camera" in said
    lines = "".join(pos_line(FLIGHT.time[k], FLIGHT.antenna(k)) for k in ALL)
    events = read_exposures(written(tmp_path / "e.pos", HEAD + lines))
    said = with_exposures(photographs, [file, events], arm).sentences
    assert "lever arms of 10 are those of the time marks, not the one given" in said[1]


TABLE = "image,longitude_deg,latitude_deg,height_m,omega_deg,phi_deg,kappa_deg,sigma_X_m,sigma_Y_m,sigma_Z_m,fix\n"


def test_a_table_by_name(tmp_path):
    gps = FLIGHT.camera[2]
    row = f"{gps.longitude_deg!r},{gps.latitude_deg!r},{gps.altitude_m!r}"
    file = written(
        tmp_path / "t.csv", TABLE + f"DJI_0003.JPG,{row},0,0,-40,0.02,0.03,0.05,fixed\nother,{row},,,1,,,,\n"
    )
    with pytest.raises(InputError, match="row 3: give all three angles"):
        read_exposures(file)
    file = written(tmp_path / "t.csv", file.read_text().replace(",,,1,,,,\n", ",,,,,,,\n"))
    found = read_exposures(file, heights="geoid")
    taken, said = with_exposures([FLIGHT.photograph(k) for k in ALL], [found])
    assert taken[2].gps == gps._replace(sigma_m=(0.02, 0.03, 0.05), heights="geoid", fix="fixed")
    # kappa turns the camera to the left, yaw to the right.
    np.testing.assert_allclose(taken[2].attitude.level_from_camera, level_from_belly(40, 0, 0), atol=1e-6)
    assert "1 of 10 photographs by name, 1 fixed" in said[0]


@pytest.mark.parametrize(
    ("exchanged", "east_m", "words"),
    [(True, 0.0, "exchanged?); not used"), (False, 5000.0, "another flight")],
)
def test_a_table_far_from_the_photographs_is_not_used(tmp_path, exchanged, east_m, words):
    places = [moved(g, np.array([east_m, 0, 0])) for g in FLIGHT.camera]
    rows = [(g.longitude_deg, g.latitude_deg)[:: -1 if exchanged else 1] for g in places]
    text = "".join(f"DJI_{k + 1:04}.jpg,{x!r},{y!r},100,0,0,10\n" for k, (x, y) in enumerate(rows))
    head = "image,longitude_deg,latitude_deg,height_m,roll_deg,pitch_deg,yaw_deg\n"
    (tmp_path / "exposures.csv").write_text(head + text)
    photographs = [FLIGHT.photograph(k) for k in ALL]
    taken, said = with_exposures(photographs, [read_exposures(tmp_path / "exposures.csv")])
    assert taken == photographs and words in said[0]


def test_a_table_on_the_map_counts_yaw_from_grid_north(tmp_path):
    place = np.array([[16.5, 57.0, 80.0]])
    at = MapFrame(3006, None, (16.5, 57.0, 0.0)).map(np.array([[0.0, 0.0, 80.0]]))[0]
    file = written(tmp_path / "t.csv", "image,X_m,Y_m,Z_m,roll_deg,pitch_deg,yaw_deg\na,{},{},{},0,0,10\n".format(*at))
    with pytest.raises(InputError, match="give the EPSG code"):
        read_exposures(file)
    found = read_exposures(file, 3006)
    np.testing.assert_allclose(found.place, place, atol=1e-7)
    # East of the central meridian (15 degrees) grid north lies east of true north by about dL sin(B).
    level = found.attitude[0].level_from_camera
    yaw = np.degrees(np.arctan2(level[0, 1], level[1, 1]))
    assert yaw == pytest.approx(10 + 1.5 * np.sin(np.deg2rad(57)), abs=1e-3)


@pytest.mark.filterwarnings("ignore:.*unknown columns")
def test_tables_without_positions_are_refused_with_the_columns(tmp_path):
    for text, words in (
        ("imagename,x,y,z\na,1,2,3\n", "give the columns image and longitude_deg, latitude_deg, height_m"),
        ("image,latitude,longitude\na,1,2\n", "give the columns image and longitude_deg"),
        ("image,longitude_deg,latitude_deg,height_m\n", "the file has no positions"),
        (TABLE_ROWS.replace("0004", "0001"), "row 5: image DJI_0001 is given twice"),
        (TABLE_ROWS.replace("0.0456", "-1"), "row 2: sigma_Z_m is -1"),
        (TABLE_ROWS.replace(",55.", ",155."), "row 2: longitude 13.2, latitude 155.7 is out of range"),
    ):
        with pytest.raises(InputError, match=words):
            read_exposures(written(tmp_path / "a.csv", text))


def test_a_table_on_a_national_datum_is_brought_to_that_of_receivers(tmp_path):
    file = written(tmp_path / "t.csv", "image,X_m,Y_m,Z_m\na,527000.25,352000.75,400.5\n")
    found = read_exposures(file, 31287, "ellipsoid")
    space = pyproj.Transformer.from_crs(pyproj.CRS(31287).to_3d(), 4979, always_xy=True)
    np.testing.assert_allclose(
        (found.place[0] - space.transform(527000.25, 352000.75, 400.5)) * [1e5, 1e5, 1], 0, atol=1e-4
    )
    assert read_exposures(file, 31287).place[0, 2] == 400.5


TABLE_ROWS = "image,longitude_deg,latitude_deg,height_m,sigma_X_m,sigma_Y_m,sigma_Z_m\n" + "".join(
    f"DJI_{k + 1:04}.JPG,{g.longitude_deg!r},{g.latitude_deg!r},{g.altitude_m:.4f},0.02,0.02,0.0456\n"
    for k, g in enumerate(FLIGHT.camera)
)
# The file, and its first row with numbers.
FORMS = {
    "a.MRK": ("".join(FLIGHT.mark(k) for k in ALL), 1),
    "a.pos": (HEAD + "".join(pos_line(FLIGHT.time[k], FLIGHT.antenna(k)) for k in ALL), 4),
    "exposures.csv": (TABLE_ROWS, 2),
}


@pytest.mark.parametrize("name", FORMS)
@pytest.mark.parametrize("put", ["55.x", "nan", ""])
def test_an_invalid_row_is_named(tmp_path, name, put):
    text, first = FORMS[name]
    path = tmp_path / name
    assert len(read_exposures(written(path, text)).place) == 10
    lines = text.split("\n")
    lines[first + 1] = re.sub(r"\d+\.\d{4,}", put, lines[first + 1], count=1)
    with pytest.raises(InputError, match=rf"{name}, row {first + 2}: "):
        read_exposures(written(path, "\n".join(lines)))


GPS, TAKE_OFF_M = 0x8825, 40.0


def picture(path, k, place=None, above_m=None, model="Model", seed=0):
    """A photograph of `FLIGHT` with its position (`place` instead: latitude, longitude; () for none) and heights."""
    at = datetime(1980, 1, 6) + timedelta(seconds=int(FLIGHT.time[k] - LEAP_SECONDS + 7200))
    exif = Image.Exif()
    exif[271], exif[272] = "Maker", model
    exif.get_ifd(0x8769).update({0x9003: f"{at:%Y:%m:%d %H:%M:%S}", 0x9011: "+02:00"})
    place = FLIGHT.camera[k][:2] if place is None else place
    if place:
        latitude, longitude = ((v, 0, 0) for v in place)
        exif.get_ifd(GPS).update({1: "N", 2: latitude, 3: "E", 4: longitude, 5: b"\0", 6: 57.0 + k})
    heights = {"Absolute": TAKE_OFF_M + 17 + k if above_m is None else above_m, "Relative": 17 + k}
    xmp = "<rdf:Description " + " ".join(f'drone-dji:{n}Altitude="+{h}"' for n, h in heights.items()) + "/>"
    grey = np.random.default_rng(100 * seed + k).integers(0, 255, (300, 400), dtype=np.uint8)
    Image.fromarray(grey).save(path / f"DJI_{k + 1:04}.jpg", exif=exif, xmp=xmp.encode())


def cut(path):
    whole = (path / "DJI_0003.jpg").read_bytes()
    (path / "cut.jpg").write_bytes(whole[: len(whole) // 2])


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clean")
    for k in ALL:
        picture(folder, k)
    return folder


def said_of(folder):
    """All sentences, each without its folder, and the photographs that are left with their positions."""
    kept, left = valid_photographs([folder])
    taken, sentences = located(kept, [folder])
    said = [s.replace(f"{folder}/", "") for s in (*left.values(), *sentences)]
    return said, {p.name: p.gps for p in taken}


FAR = (56.7, 13.2)
SPOILT = {
    "truncated": (cut, "cut.jpg: the image is cut off or damaged", ()),
    "no picture": (lambda f: (f / "x.jpg").write_text("none"), "x.jpg: not a readable image", ()),
    "doubled": (lambda f: shutil.copy(f / "DJI_0002.jpg", f / "DJI_0002 (1).jpg"), "it is a copy of DJI_0002", ()),
    "screenshot": (lambda f: Image.new("RGB", (640, 480)).save(f / "s.png"), "s.png: its size is 640 x 480 px", ()),
    "other camera": (lambda f: picture(f, 4, model="Other"), "its camera is Maker Other", ("DJI_0005",)),
    "without a position": (
        lambda f: picture(f, 4, ()),
        "1 of 10 photographs has no position (DJI_0005)",
        ("DJI_0005",),
    ),
    "at (0, 0)": (lambda f: picture(f, 4, (0.0, 0.0)), "DJI_0005 are (0, 0)", ("DJI_0005",)),
    "swapped": (lambda f: picture(f, 4, FLIGHT.camera[4][1::-1]), "latitude and longitude exchanged", ("DJI_0005",)),
    "far away": (lambda f: picture(f, 4, FAR), "DJI_0005 are more than 50 km from the others", ("DJI_0005",)),
    "file of no marks": (lambda f: (f / "b.MRK").write_text("no\n"), "b.MRK, row 1", ()),
}


@pytest.mark.parametrize("kind", SPOILT)
def test_each_invalid_input_costs_one_message(clean, tmp_path, kind):
    spoil, words, lost = SPOILT[kind]
    before, sound = said_of(clean)
    folder = shutil.copytree(clean, tmp_path / "flight")
    spoil(folder)
    said, found = said_of(folder)
    assert [words in s for s in said if s not in before] == [True], said
    assert {n: g for n, g in found.items() if g} == {n: g for n, g in sound.items() if n not in lost}
