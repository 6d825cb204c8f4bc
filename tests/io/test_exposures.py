"""Files of exposures: read, matched to photographs, reduced to the camera; each invalid input costs one message."""

import re
import shutil
from datetime import datetime, timedelta

import numpy as np
import pyproj
import pytest
from jaxphoto.georeferencing.exposure_times import LEAP_SECONDS, WEEK_S, Taken
from PIL import Image
from pyproj import CRS

from jaxphoto.errors import InputError
from jaxphoto.georeferencing.camera_attitude import CameraAttitude, level_from_belly
from jaxphoto.georeferencing.gps import FIX_SIGMA_M, Gps, moved
from jaxphoto.georeferencing.map_frame import MapFrame
from jaxphoto.io.exposures import located, read_exposures, with_exposures
from jaxphoto.io.photographs import Photograph, valid_photographs
from jaxphoto.io.trajectory import write_sbet
from tests import sound_files

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
        own = Photograph(f"DJI_{k + 1:04}", None, 400, 300, gps=gps, taken=Taken(clock, 1.0, ahead_s if told else None))
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
    for words in (
        "7 of 8 photographs (none for DJI_0003; 2 of its exposures without a photograph, rows 5, 9) by number, 7 fixed",
        "+2 h (time zone), -18 s (leap seconds",
    ):
        assert words in said[0], said


@pytest.mark.parametrize(("shift_s", "words"), [(-8 * 3600.0, "+8 h (time zone)"), (-18.0, "+18 s (leap seconds")])
def test_marks_in_a_wrong_time_zone_or_in_utc_are_corrected_and_reported(tmp_path, shift_s, words):
    file = read_exposures(written(tmp_path / "a.MRK", "".join(FLIGHT.mark(k, k + 31, shift_s) for k in ALL)))
    taken, said = with_exposures([FLIGHT.photograph(k, told=True, name=f"IMG{k}") for k in ALL], [file])
    assert all(same(p.gps, c) for p, c in zip(taken, FLIGHT.camera, strict=True))
    assert "by time" in said[0] and words in said[0] and "which is corrected" in said[0]


@pytest.mark.parametrize("lost", [0, 2])
def test_renumbered_marks_are_matched_by_positions(tmp_path, lost):
    """Exposures at equal intervals: the numbers fit the times as well, shifted by one."""
    steady = Flight()
    steady.time = BEGIN_S + 3.0 * np.arange(10)
    left = [k for k in ALL if k != lost]
    file = read_exposures(written(tmp_path / "a.MRK", "".join(steady.mark(k, n + 1) for n, k in enumerate(left))))
    receiver = [moved(g, np.array([0.8, -0.6, 0.0])) for g in steady.camera]
    own = [steady.photograph(k, gps=receiver[k]) for k in ALL]
    taken, said = with_exposures(own, [file])
    assert all(same(taken[k].gps, steady.camera[k]) for k in left) and taken[lost] == own[lost], said
    assert "by time" in said[0]
    blind = [p._replace(gps=None) for p in own]
    taken, said = with_exposures(blind, [file])
    if lost:
        assert all(same(taken[k].gps, steady.camera[k]) for k in left)
    else:
        assert taken == blind and "no positions resolve this; not used" in said[0]
        # Numbers that begin with 2 were kept.
        kept = read_exposures(written(tmp_path / "b.MRK", "".join(steady.mark(k) for k in left)))
        taken, said = with_exposures(blind, [kept])
        assert all(same(taken[k].gps, steady.camera[k]) for k in left) and "by number" in said[0]


def test_marks_of_two_flights_that_both_count_from_one(tmp_path):
    """The second flight repeats the intervals of the first: its numbers fit the first's photographs, too."""
    both = Flight(20)
    both.time[10:] = both.time[:10] + 600.0
    both.camera[10:] = [moved(g, np.array([15.0, 3.0, 0.0])) for g in both.camera[:10]]
    for name, first in (("a", 0), ("b", 10)):
        written(tmp_path / f"{name}.MRK", "".join(both.mark(first + k, k + 1) for k in ALL))
    files = [read_exposures(tmp_path / f"{name}.MRK") for name in "ab"]
    own = [both.photograph(k, gps=moved(both.camera[k], np.array([0.8, -0.6, 0.0]))) for k in range(20)]
    taken, said = with_exposures(own, files)
    assert all(same(p.gps, c) for p, c in zip(taken, both.camera, strict=True)), said
    blind = [p._replace(gps=None) for p in own]
    taken, said = with_exposures(blind, files)
    assert taken == blind and all("no positions resolve this" in s for s in said)


def test_marks_of_another_day_need_positions_that_prove_the_clock(tmp_path):
    file = read_exposures(written(tmp_path / "a.MRK", "".join(FLIGHT.mark(k, shift_s=-3 * 86400) for k in ALL)))
    own = [FLIGHT.photograph(k) for k in ALL]
    for unproven in ([p._replace(gps=None) for p in own], [p._replace(gps=moved(p.gps, ARM * 200)) for p in own]):
        taken, said = with_exposures(unproven, [file])
        assert taken == unproven and "its times are 3.1 days before those of the photographs" in said[0]
    taken, said = with_exposures(own, [file])
    assert all(same(p.gps, c) for p, c in zip(taken, FLIGHT.camera, strict=True))
    assert "+3.08 days, more than any time zone" in said[0] and "omit the file" in said[0]


def test_marks_of_another_flight_are_not_used(tmp_path):
    file = read_exposures(written(tmp_path / "a.MRK", "".join(FLIGHT.mark(k) for k in ALL)))
    away = [FLIGHT.photograph(k, gps=moved(FLIGHT.camera[k], np.array([900.0, 0, 0]))) for k in ALL]
    taken, said = with_exposures(away, [file])
    assert taken == away and "another flight?); not used" in said[0]
    unknown = [FLIGHT.photograph(k, taken=None, name=f"IMG{k}") for k in ALL]
    assert "match its times with a common clock offset; not used" in with_exposures(unknown, [file]).sentences[0]


def test_events_of_the_antenna_are_brought_to_the_camera_by_the_arms_of_the_marks(tmp_path):
    marks = read_exposures(written(tmp_path / "a.MRK", "".join(FLIGHT.mark(k, sigma=1.1, flag=16) for k in ALL)))
    # One event is missing, and one is surplus.
    lines = "".join(pos_line(FLIGHT.time[k], FLIGHT.antenna(k), 2 if k == 1 else 1) for k in ALL if k != 4)
    events = read_exposures(written(tmp_path / "a_events.pos", HEAD + pos_line(BEGIN_S - 30, ORIGIN) + lines))
    taken, said = with_exposures([FLIGHT.photograph(k) for k in ALL], [events, marks])
    assert all(same(p.gps, c, 2e-3) for p, c in zip(taken, FLIGHT.camera, strict=True))
    assert [p.gps.fix for p in taken] == ["fixed", "float", *["fixed"] * 2, "single", *["fixed"] * 5]
    assert taken[0].gps.sigma_m == (0.0072, 0.0061, 0.0143)
    assert "9 of 10 photographs (none for DJI_0005; 1 of its exposures without a photograph, row 4)" in said[1]
    assert "8 fixed, 1 float; lever arms of 9 are those of the time marks" in said[1]


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
    assert "positions of 8 photographs by interpolation" in said[1]
    assert "2 before, after or in a gap of it: DJI_0004, DJI_0010" in said[1]


def test_a_trajectory_without_exact_times_is_not_used(tmp_path):
    lines = "".join(pos_line(BEGIN_S + 0.2 * k, ORIGIN) for k in range(100))
    file = read_exposures(written(tmp_path / "a.pos", HEAD + lines))
    assert (
        "needs the time of every exposure to the millisecond"
        in with_exposures([FLIGHT.photograph(k) for k in ALL], [file]).sentences[0]
    )
    exact = [FLIGHT.photograph(k, taken=Taken(FLIGHT.time[k] - 18 + 9e6, 1e-6, 0.0)) for k in ALL]
    assert "no photograph within its time span" in with_exposures(exact, [file]).sentences[0]


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
    taken, said = located([FLIGHT.photograph(k) for k in ALL], [tmp_path])
    assert all(same(p.gps, c, 0.1) for p, c in zip(taken, FLIGHT.camera, strict=True))
    expected = level_from_belly(np.degrees(1.1), 0.0, np.degrees(0.01))
    np.testing.assert_allclose(taken[0].attitude.level_from_camera, expected, atol=1e-9)
    assert any("flight.sbet: positions of 10 photographs by interpolation" in s for s in said)
    assert any("10 are positions of the IMU, the lever arm is unknown" in s for s in said)
    assert taken[0].gps.stated_sigma_m == FIX_SIGMA_M["integrated"] and any("10 integrated" in s for s in said)
    # Events of the antenna, two of them lost, tell the times as well; their file comes after that of the trajectory.
    (tmp_path / "x.MRK").unlink()
    lines = [pos_line(FLIGHT.time[k], FLIGHT.antenna(k)) for k in ALL if k not in (3, 8)]
    (tmp_path / "z_events.pos").write_text(HEAD + "".join(lines))
    taken, said = located([FLIGHT.photograph(k) for k in ALL], [tmp_path], heights="ellipsoid")
    assert [p.gps.fix == "integrated" for p in taken] == [k not in (3, 8) for k in ALL], said
    assert all(same(p.gps, c, 0.1) for p, c in zip(taken, FLIGHT.camera, strict=True) if p.gps.fix == "integrated")


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
    with pytest.raises(InputError, match="row 3: omega is empty"):
        read_exposures(file)
    file = written(tmp_path / "t.csv", file.read_text().replace(",,,1,,,,\n", ",,,,,,,\n"))
    found = read_exposures(file, heights="geoid")
    taken, said = with_exposures([FLIGHT.photograph(k) for k in ALL], [found])
    assert taken[2].gps == gps._replace(sigma_m=(0.02, 0.03, 0.05), heights="geoid", fix="fixed")
    # kappa turns the camera to the left, yaw to the right.
    np.testing.assert_allclose(taken[2].attitude.level_from_camera, level_from_belly(40, 0, 0), atol=1e-6)
    assert "1 of 10 photographs (none for DJI_0001, DJI_0002, DJI_0004 and 6 more; 1 of its" in said[0]


@pytest.mark.parametrize(
    ("exchanged", "east_m", "words"),
    [(True, 0.0, "longitude and latitude are interchanged"), (False, 5000.0, "another flight?); not used")],
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


TURNED = (40.0, 5.0, -3.0)
"""Yaw, pitch and roll of all photographs in the tables of other programs."""
BELLY, ZONE = "{},{},{}".format(*TURNED), 32633


def on_the_map(k):
    gps = FLIGHT.camera[k]
    frame = MapFrame(ZONE, None, (ORIGIN.longitude_deg, ORIGIN.latitude_deg, 0.0))
    return frame.map(frame.local_from_place(np.array([[gps.longitude_deg, gps.latitude_deg, gps.altitude_m]])))[0]


def grid_angles(k):
    """omega, phi, kappa against grid north, which lies east of true north by about dL sin(B)."""
    g = np.deg2rad((FLIGHT.camera[k].longitude_deg - 15) * np.sin(np.deg2rad(FLIGHT.camera[k].latitude_deg)))
    grid_from_level = np.array([[np.cos(g), -np.sin(g), 0], [np.sin(g), np.cos(g), 0], [0, 0, 1]])
    r = (grid_from_level @ level_from_belly(*TURNED)).T
    return np.rad2deg([np.arctan2(-r[2, 1], r[2, 2]), np.arcsin(r[2, 0]), np.arctan2(-r[1, 0], r[0, 0])])


def table_of(head, row, between=","):
    """Of six photographs: `row` is given the name, longitude, latitude, height, then X, Y, then omega, phi, kappa."""
    lines = []
    for k in range(6):
        gps, (x, y, _) = FLIGHT.camera[k], on_the_map(k)
        cells = (f"DJI_{k + 1:04}.JPG", gps.longitude_deg, gps.latitude_deg, gps.altitude_m, x, y, *grid_angles(k))
        lines.append(row.format(*cells).replace(",", between))
    return head.replace(",", between) + "\n" + "\n".join(lines) + "\n"


PIX4D = "imagename,latitude,longitude,altitude,accuracy horizontal,accuracy vertical"
METASHAPE = "#Label,X/Longitude,Y/Latitude,Z/Altitude,Yaw,Pitch,Roll,X_acc_(m),Y_acc_(m),Z_acc_(m),X_est"
UTM = "+proj=utm +zone=33 +ellps=WGS84 +datum=WGS84 +units=m +no_defs"
POSPAC_ROW = "{0} 7 1234.5 {4} {5} {3} {6} {7} {8} {2} {1}"
OPK = "# X Y Z (m) of EPSG:32633, heights above the ellipsoid\nimageName,X,Y,Z,Omega,Phi,Kappa"
OTHERS = {
    "pix4d": (table_of(PIX4D, "{0},{2},{1},{3},0.02,0.05"), False, True),
    "pix4d-ypr": (table_of(f"{PIX4D},yaw,pitch,roll", "{0},{2},{1},{3},0.02,0.05," + BELLY), True, True),
    "pix4d-map": (table_of("# EPSG:32633\nimagename,x,y,z,yaw,pitch,roll", "{0},{4},{5},{3}," + BELLY), True, False),
    "metashape": (table_of(METASHAPE, "{0},{1},{2},{3}," + BELLY + ",0.02,0.02,0.05,7"), True, True),
    "odm": (table_of("EPSG:4326", "{0},{1},{2},{3}," + BELLY + ",0.02,0.05", " "), True, True),
    "odm-map": (table_of(UTM, "{0},{4},{5},{3},0,0,0,0.02,0.05", "\t"), False, True),
    "opk": (
        table_of(
            "# X Y Z (m) of EPSG:32633, heights above the ellipsoid\nimageName,X,Y,Z,Omega,Phi,Kappa",
            "{0},{4},{5},{3},{6},{7},{8}",
            "\t",
        ),
        True,
        False,
    ),
    "pospac": (sound_files.POSPAC_HEAD + table_of("", POSPAC_ROW), True, False),
    "ours": (table_of("IMAGE,Longitude_deg,Latitude_deg,Height_m", "{0},{1},{2},{3}").lower(), False, False),
    "blanks": (table_of("image,longitude_deg,latitude_deg,height_m", "{0},{1},{2},{3}", "  "), False, False),
}


@pytest.mark.parametrize("form", OTHERS)
def test_tables_of_other_programs(tmp_path, form):
    text, turned, stated = OTHERS[form]
    found = read_exposures(written(tmp_path / "a.txt", text))
    taken, said = with_exposures([FLIGHT.photograph(k) for k in ALL], [found])
    assert "positions of 6 of 10 photographs" in said[0]
    assert all(same(taken[k].gps, FLIGHT.camera[k]) for k in range(6))
    assert found.heights == ("ellipsoid" if form in ("opk", "pospac") else "unknown")
    assert {p.gps.sigma_m for p in taken[:6]} == {(0.02, 0.02, 0.05) if stated else None}
    for p in taken[:6]:
        assert (p.attitude is not None) == turned
        if turned:
            np.testing.assert_allclose(p.attitude.level_from_camera, level_from_belly(*TURNED), atol=2e-5)


@pytest.mark.parametrize(
    "old, new, words",
    [
        ("= 15.0", "= 9.0", "row 17: its easting and northing are .* from its latitude and longitude in EPSG:32632"),
        ("= 15.0", "= 14.0", "are map coordinates; give the EPSG code"),
        ("the 'x' by", "the 'y' by", "its first rotation is about y"),
        ("ID, # EVENT, TIME", "TIME, DISTANCE, TIME", "missing photograph columns"),
        ("EASTING, NORTHING", "E, N", "no columns in the header"),
    ],
)
def test_inconsistent_pospac_texts_are_refused(tmp_path, old, new, words):
    text = OTHERS["pospac"][0]
    assert old in text
    with pytest.raises(InputError, match=words):
        read_exposures(written(tmp_path / "eo.txt", text.replace(old, new)))


def test_a_row_of_pospac_that_is_too_short_is_left_out(tmp_path):
    text = OTHERS["pospac"][0].replace("DJI_0002.JPG 7 1234.5", "DJI_0002.JPG 7")
    assert "row 18: 10 cells, but the header has 11" in read_exposures(written(tmp_path / "eo.txt", text)).why


def test_ambiguous_tables_are_refused(tmp_path):
    for text, words in (
        (table_of("imageName,X,Y,Z", "{0},{4},{5},{3}"), "are map coordinates; give the EPSG code"),
        (table_of("#imagename,coordinate1,coordinate2,z", "{0},{1},{2},{3}"), "add a header"),
        (table_of("imagename,latitude,longitude", "{0},{2},{1}"), "no height column in the header"),
        (table_of("label,lon,lat,z,omega [gon],phi,kappa", "{0},{1},{2},{3},0,0,0"), "its angles are in gon"),
        (table_of("EPSG:4326", "{0},{1}", " "), "row 2: y is empty"),
        (table_of("EPSG:4326", "{0},{1},{2}", " "), "row 2: z is empty"),
    ):
        with pytest.raises(InputError, match=words):
            read_exposures(written(tmp_path / "a.txt", text))


def test_rows_that_are_switched_off_are_left_out(tmp_path):
    wkt = CRS.from_epsg(ZONE).to_wkt("WKT1_GDAL").replace("\n", "")
    text = table_of(f"#CoordinateSystem: {wkt}\n#Label,Enable,X/Easting,Y/Northing,Z/Altitude", "{0},1,{4},{5},{3}")
    found = read_exposures(written(tmp_path / "a.txt", text.replace("0002.JPG,1", "0002.JPG,0")))
    assert found.names == ("DJI_0001", "DJI_0003", "DJI_0004", "DJI_0005", "DJI_0006")
    assert same(found.gps(1), FLIGHT.camera[2])


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
    "pix4d.csv": (TABLE_ROWS.replace("image,long", "imagename;long").replace(",", ";"), 2),
    "geo.txt": ("EPSG:4326\n" + "\n".join(TABLE_ROWS.replace(",", " ").split("\n")[1:]), 2),
    "eo.txt": (OTHERS["pospac"][0], 17),
}


def at_row(text, row, change):
    lines = text.split("\n")
    lines[row - 1] = change(lines[row - 1])
    return "\n".join(lines)


@pytest.mark.parametrize("name", FORMS)
def test_invalid_rows_are_skipped_and_named(tmp_path, name):
    text, first = FORMS[name]
    path = tmp_path / name
    whole = read_exposures(written(path, text))
    n = len(whole.rows)
    assert whole.why == "" and whole.rows.tolist() == list(range(first, first + n))
    put = lambda word: lambda line: re.sub(r"\d+\.\d{4,}", word, line, count=1)  # noqa: E731
    letters = put("55.x")
    spoilt = {
        "letters": (at_row(text, first + 2, letters), [first + 2]),
        "nan": (at_row(text, first, put("nan")), [first]),
        # In the middle of a row, and where half a number is left: only the missing cells tell it.
        "cut": (text.rstrip("\n")[:-30], [first + n - 1]),
        "two": (at_row(at_row(text, first, letters), first + 1, lambda line: line[:25]), [first, first + 1]),
    }
    for kind, (spoilt_text, rows) in spoilt.items():
        found = read_exposures(written(path, spoilt_text))
        kept = ~np.isin(whole.rows, rows)
        assert found.rows.tolist() == whole.rows[kept].tolist(), kind
        np.testing.assert_array_equal(found.place, whole.place[kept])
        assert found.without == tuple(rows) and re.search(f"; row ({'|'.join(map(str, rows))}): ", found.why)
        assert f"{len(rows)} of {n} row" in found.why
    worse = text
    for row in range(first, first + n // 2):
        worse = at_row(worse, row, letters)
    with pytest.raises(InputError, match=r"row \d+: "):
        read_exposures(written(path, worse))


def test_errors_of_a_whole_table_name_no_row(tmp_path):
    text = table_of("imageName,X,Y,Z", "{0},{4},{5},{3}")
    with pytest.raises(InputError, match="are map coordinates; give the EPSG code"):
        read_exposures(written(tmp_path / "a.csv", at_row(text, 3, lambda line: line + '"')))
    # Which of two rows of one name is right nobody knows.
    found = read_exposures(
        written(tmp_path / "a.csv", at_row(TABLE_ROWS, 5, lambda line: line.replace("0004", "0001")))
    )
    assert found.without == (2, 5) and "it is given twice" in found.why and len(found.rows) == 8


def test_numbers_are_not_used_if_an_invalid_row_may_hide_a_renumbering(tmp_path):
    """The first exposure is not in the file, which counts from 1, and a row in its middle is spoilt."""
    steady = Flight()
    steady.time = BEGIN_S + 3.0 * np.arange(10)
    text = "".join(steady.mark(k, k) for k in range(1, 10))
    file = read_exposures(written(tmp_path / "a.MRK", at_row(text, 4, lambda line: line.replace("55.", "x"))))
    blind = [steady.photograph(k, gps=None) for k in ALL]
    taken, said = with_exposures(blind, [file])
    assert taken == blind and "not used" in said[0] and "1 of 9 rows is skipped (4); row 4" in said[0]


GPS, ZONE_S = 0x8825, 7200
TAKE_OFF_M = 40.0


def picture(path, k, place=None, above_m=None, model="Model", seed=0):
    """A photograph of `FLIGHT` with its position (`place` instead: latitude, longitude; () for none) and heights."""
    at = datetime(1980, 1, 6) + timedelta(seconds=int(FLIGHT.time[k] - LEAP_SECONDS + ZONE_S))
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


def marks(path, shift_s=0.0):
    # Names that carry no number of the marks: times alone join them.
    (path / "a.MRK").write_text("".join(FLIGHT.mark(k, k + 31, shift_s) for k in ALL))


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
    "swapped": (lambda f: picture(f, 4, FLIGHT.camera[4][1::-1]), "DJI_0005 are swapped", ()),
    "far away": (lambda f: picture(f, 4, FAR), "DJI_0005 are more than 50 km from the others", ("DJI_0005",)),
    "above take-off": (lambda f: picture(f, 4, above_m=21), "DJI_0005 are above take-off", ()),
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


@pytest.mark.parametrize(("zone_s", "words"), [(-8 * 3600.0, "+8 h (time zone)"), (7200.0, "-2 h (time zone)")])
def test_a_wrong_time_zone_of_marks_is_one_sentence(clean, tmp_path, zone_s, words):
    right, wrong = (shutil.copytree(clean, tmp_path / name) for name in ("right", "wrong"))
    # Names with numbers that are not those of the marks.
    for folder in (right, wrong):
        for path in folder.glob("*.jpg"):
            path.rename(folder / path.name.replace("DJI_", "IMG"))
    marks(right)
    marks(wrong, zone_s)
    (before, sound), (said, found) = said_of(right), said_of(wrong)
    assert [words in s and s.endswith("which is corrected") for s in said if s not in before] == [True], said
    assert found == sound and all(g.heights == "ellipsoid" for g in found.values())


def test_a_wrong_row_of_marks_is_one_sentence(clean, tmp_path):
    right, wrong = (shutil.copytree(clean, tmp_path / name) for name in ("right", "wrong"))
    for folder in (right, wrong):
        marks(folder)
    (wrong / "a.MRK").write_text((right / "a.MRK").read_text().replace("34\t", "34\tx"))
    (before, sound), (said, found) = said_of(right), said_of(wrong)
    mine = [s for s in said if s.startswith("a.MRK")]
    assert len(mine) == 1 and mine[0] not in before and "1 of 10 rows is skipped (4); row 4: " in mine[0], mine
    assert [n for n, g in found.items() if g != sound[n]] == ["DJI_0004"] and found["DJI_0004"] is not None
