"""Blocks with stations, attitudes and motion from a trajectory or from tables."""

import dataclasses

import jax
import numpy as np
import pandas as pd
import pytest
from pyproj import Transformer

from jaxphoto.block import Frame
from jaxphoto.errors import BlockError, InputError
from jaxphoto.io import read_block, write_block
from jaxphoto.io.block_folder.settings import frame_section
from jaxphoto.io.trajectory import FIELDS, Records, trajectory_in, with_poses, write_flight_csv, write_sbet
from jaxphoto.rotation import matrix_from_roll_pitch_yaw, roll_pitch_yaw_from_matrix
from tests.derivatives import compiled

START, TIMES = 350_000.0, (1.01, 3.33, 9.99)
FIX_OFFSET = ("block.toml", "[mounts.default]", '[mounts.default]\ntime_offset = "free"')

matrices = compiled(jax.vmap(matrix_from_roll_pitch_yaw))


def motion(t):
    """Local X, Y, Z (m) and roll, pitch, yaw (degrees) at seconds from the start: a curve to the left, flown east."""
    t = np.asarray(t)
    position = np.stack([60 * t, 0.2 * t**2, 1000 + 3 * np.sin(t / 2)], axis=-1)
    angles = np.stack([2 * np.sin(t), 1 + np.cos(0.7 * t), 90 - 0.4 * t], axis=-1)
    return position, angles


def flight(shift=0.0, sigma=0.02, keep=lambda t: t > -1) -> Records:
    t = np.arange(-2, 25.0001, 0.05)
    t = t[keep(t)]
    position, angles = motion(t)
    given = np.full((len(t), 3), sigma)
    return Records("flight.csv", t + START + shift, position, False, angles, given, given / 20)


def timed(*seconds) -> tuple[str, str, str]:
    rows = "".join(f"{i},kodak,one,{float(START + s)!r}\n" for i, s in zip("abc", seconds, strict=True))
    return ("images.csv", "", "image,camera,strip,time_s\n" + rows)


@pytest.fixture
def fly(write_folder):
    """Writes the small block with a trajectory for its stations; `text` goes under [trajectory]."""

    def make(records=None, times=TIMES, text="", *changes):
        files = [("stations.csv", "", None), ("attitudes.csv", "", None), timed(*times)]
        toml = ("block.toml", "[sigmas]", f'[trajectory]\nfile = "flight.csv"\n{text}\n[sigmas]')
        folder = write_folder(*files, toml, *changes)
        write_flight_csv(records or flight(), folder / "flight.csv")
        return folder

    return make


def test_positions_attitudes_and_motion_are_those_of_the_flight(fly):
    times = np.array(TIMES)
    block = read_block(fly())
    position, angles = motion(times)
    np.testing.assert_array_equal(block.stations.who, np.repeat([0, 1, 2], 3))
    np.testing.assert_allclose(np.asarray(block.stations.value).reshape(-1, 3), position, rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.rad2deg(block.attitudes.roll_pitch_yaw), angles, rtol=0, atol=1e-5)
    step = 1e-4
    velocity = (motion(times + step)[0] - motion(times - step)[0]) / (2 * step)
    np.testing.assert_allclose(block.motion.velocity, velocity, rtol=0, atol=1e-4)
    before, after = (matrices(np.deg2rad(motion(times + s)[1])) for s in (-step, step))
    turn = np.einsum("nji,njk->nik", before, after) / (2 * step)
    rate = np.stack([turn[:, 2, 1], turn[:, 0, 2], turn[:, 1, 0]], axis=1)
    np.testing.assert_allclose(block.motion.rate, rate, rtol=0, atol=1e-5)
    # The interpolation adds nothing worth mentioning to what the file states.
    np.testing.assert_allclose(block.stations.sigma, 0.02, rtol=1e-3)
    np.testing.assert_allclose(np.rad2deg(block.attitudes.sigma), 0.001, rtol=1e-2)
    # Drift is still counted from the mean time of the strip.
    np.testing.assert_allclose(block.image_time, times - times.mean(), rtol=0, atol=1e-6)


def test_coarse_records_cost_accuracy(fly):
    coarse = flight(keep=lambda t: np.isclose(t % 2, 0) | np.isclose(t % 2, 2))
    block = read_block(fly(coarse))
    assert (np.asarray(block.stations.sigma).reshape(-1, 3)[:, 2] > 0.025).any()
    position = motion(np.array(TIMES))[0].ravel()
    assert (np.abs(block.stations.value - position) < 3 * np.asarray(block.stations.sigma)).all()


def test_default_sigmas_are_those_of_block_toml(fly, write_folder):
    records = flight()._replace(sigma_m=np.full((len(flight().time), 3), np.nan))
    np.testing.assert_allclose(read_block(fly(records)).stations.sigma, 0.10, rtol=1e-3)


def test_an_image_without_a_time_has_no_station(fly):
    images = ("images.csv", f"b,kodak,one,{START + 3.33!r}", "b,kodak,one,")
    folder = fly(None, TIMES, "", ("block.toml", 'drift = "free"', ""))
    (folder / "images.csv").write_text((folder / "images.csv").read_text().replace(*images[1:]))
    np.testing.assert_array_equal(read_block(folder).attitudes.image, [0, 2])


def test_a_shift_of_the_clock(fly):
    shifted = read_block(fly(flight(shift=18.0), text="shift_s = 18.0"))
    np.testing.assert_allclose(shifted.stations.value[:3], motion(1.01)[0], rtol=0, atol=1e-6)


@pytest.mark.parametrize("wander", [0.0, 0.3])
def test_sbet_in_an_epsg_frame(fly, wander):
    """Roll, pitch and heading refer to the level and true north of the place, wherever the origin is."""
    records = flight()
    local = Transformer.from_pipeline(
        "+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lon_0=-50.2 +lat_0=-25.1 +step +inv +proj=cart "
        "+ellps=WGS84"
    )
    longitude, latitude, height = local.transform(*records.coordinates.T, radians=False)
    values = np.zeros((len(records.time), len(FIELDS)))
    columns = dict(zip(FIELDS, range(len(FIELDS)), strict=True))
    values[:, columns["time"]], values[:, columns["altitude"]] = records.time, height
    values[:, columns["longitude"]], values[:, columns["latitude"]] = np.deg2rad([longitude, latitude])
    roll, pitch, yaw = np.deg2rad(records.roll_pitch_yaw_deg).T
    values[:, columns["roll"]], values[:, columns["pitch"]] = roll, pitch
    values[:, columns["platform_heading"]], values[:, columns["wander_angle"]] = yaw + wander, wander
    epsg = 'kind = "epsg"\ncode = 32722\nvertical = "ellipsoidal"\norigin = [-50.2, -25.1, 0.0]'
    frame = ("block.toml", 'kind = "local"', epsg)
    points = ("control_points.csv", "", None), ("object_points.csv", "", None)
    folder = fly(records, TIMES, "", frame, *points, ("distances.csv", "", None))
    write_sbet(values, folder / "flight.sbet")
    (folder / "block.toml").write_text((folder / "block.toml").read_text().replace("flight.csv", "flight.sbet"))
    block = read_block(folder)
    position, angles = motion(np.array(TIMES))
    np.testing.assert_allclose(np.asarray(block.stations.value).reshape(-1, 3), position, rtol=0, atol=1e-5)
    level = block.frame.map.local_from_level(position)
    expected = level @ matrices(np.deg2rad(angles))
    got = matrices(block.attitudes.roll_pitch_yaw)
    np.testing.assert_allclose(got, expected, rtol=0, atol=1e-7)


@pytest.mark.parametrize("north", ["true", "grid"])
def test_csv_in_a_map_system(fly, north):
    frame = Frame("epsg", 32722, None, north, (-51.2, -25.1, 0.0))
    epsg = "\n".join(f"{k} = {v}" for k, v in frame_section(frame).items() if k not in ("kind", "vertical", "yaw"))
    epsg = f'kind = "epsg"\nvertical = "ellipsoidal"\nyaw = "{north}"\n{epsg}'
    records = flight()
    axes = frame.map.local_from_level if north == "true" else frame.map.local_from_grid
    bodies = matrices(np.deg2rad(records.roll_pitch_yaw_deg))
    angles = compiled(jax.vmap(roll_pitch_yaw_from_matrix))(np.swapaxes(axes(records.coordinates), 1, 2) @ bodies)
    written = records._replace(coordinates=frame.map.map(records.coordinates), roll_pitch_yaw_deg=np.rad2deg(angles))
    points = ("control_points.csv", "", None), ("object_points.csv", "", None), ("distances.csv", "", None)
    folder = fly(written, TIMES, "", ("block.toml", 'kind = "local"', epsg), *points)
    block = read_block(folder)
    position, expected = motion(np.array(TIMES))
    assert block.frame == frame
    np.testing.assert_allclose(np.asarray(block.stations.value).reshape(-1, 3), position, rtol=0, atol=1e-5)
    np.testing.assert_allclose(np.rad2deg(block.attitudes.roll_pitch_yaw), expected, rtol=0, atol=1e-5)


@pytest.mark.parametrize("frame", [Frame(), Frame("epsg", 32722, None, "grid", (-51.2, -25.1, 0.0))], ids=str)
def test_poses_in_the_frame_of_a_block_go_back_into_records(frame):
    """Whatever becomes of a trajectory, its file has the axes and the system that it came in."""
    records, none = flight(), np.zeros((len(flight().time), 3))
    if frame.kind == "epsg":
        records = records._replace(coordinates=frame.map.map(records.coordinates))
    there = trajectory_in(records, frame, none, none)
    back = with_poses(records._replace(coordinates=none, roll_pitch_yaw_deg=none), there, frame)
    np.testing.assert_allclose(back.coordinates, records.coordinates, rtol=0, atol=1e-6)
    off = (back.roll_pitch_yaw_deg - records.roll_pitch_yaw_deg + 180) % 360 - 180
    np.testing.assert_allclose(off, 0.0, rtol=0, atol=1e-9)


DAY = 86_400


def test_exposures_outside_the_trajectory_are_refused(fly):
    with pytest.raises(BlockError, match=r"images\.csv, row \d+.*image a is exposed outside flight\.csv.*shift_s"):
        read_block(fly(times=np.array(TIMES) - 4 * DAY))


@pytest.mark.parametrize("epoch", [START, 0.0], ids=["of the week", "from the first exposure"])
@pytest.mark.parametrize("of", ["flight.csv", "images.csv"])
def test_times_in_milliseconds_are_named(fly, of, epoch):
    """Times from the first exposure lie within the trajectory in either unit, but between few of its records."""
    records, times = flight(-START + epoch), np.array(TIMES) + epoch - START
    if of == "flight.csv":
        records = records._replace(time=1000 * records.time)
    else:
        times = 1000 * (times + START) - START
    with pytest.raises(InputError, match=rf"{of}: .*milliseconds"):
        read_block(fly(records, times))


def holed():
    return flight(keep=lambda t: (t < 3.01) | (t > 4.02))


def test_a_gap_that_is_allowed(fly):
    block = read_block(fly(holed(), text="max_gap_s = 2.0"))
    np.testing.assert_allclose(block.stations.value[3:6], motion(3.33)[0], rtol=0, atol=0.01)


UNKNOWN = np.full((len(flight().time), 3), np.nan)
REFUSED = {
    "no sigma": (
        lambda fly: fly(flight()._replace(sigma_deg=UNKNOWN), TIMES, "", ("block.toml", "attitude_deg = 0.01\n", "")),
        r"flight\.csv: .* add attitude_deg under \[sigmas\] in block\.toml",
    ),
    "places in a local frame": (
        lambda fly: fly(flight()._replace(coordinates=flight().coordinates / 100, geographic=True)),
        r'flight\.csv: .*longitude.*"local".*write kind = "epsg"',
    ),
    "gap": (lambda fly: fly(holed()), r"row 3: image b .* 350003\.330 s in a gap of flight\.csv.*max_gap_s"),
    "key": (
        lambda fly: fly(text="max_gap = 1.0"),
        r"\[trajectory\] max_gap: unknown key; use file, shift_s, max_gap_s",
    ),
    "stations": (
        lambda fly: _beside(fly(), "stations.csv", "image,X_m,Y_m,Z_m\na,1,2,3\n"),
        r"stations\.csv: .* flight\.csv; remove this file, or \[trajectory\]",
    ),
    "no file": (lambda fly: _beside(fly(), "flight.csv", None), r"file not found: .*flight\.csv; add it"),
}  # fmt: skip


def _beside(folder, name, text):
    (folder / name).unlink(missing_ok=True)
    if text is not None:
        (folder / name).write_text(text)
    return folder


@pytest.mark.parametrize("name", REFUSED)
def test_invalid_trajectories_are_refused(fly, name):
    write, message = REFUSED[name]
    with pytest.raises((InputError, BlockError), match=message):
        read_block(write(fly))


# Motion in the tables ---------------------------------------------------------------------------------------


def with_motion(folder, velocity=True, rate=True):
    if velocity:
        table = pd.read_csv(folder / "stations.csv")
        table.assign(vX_m_per_s=[60.0, 61.0], vY_m_per_s=[0.5, 0.25], vZ_m_per_s=[-0.1, 0.3]).to_csv(
            folder / "stations.csv", index=False
        )
    if rate:
        table = pd.read_csv(folder / "attitudes.csv")
        names = ("right", "forward", "up")
        columns = {f"rate_{n}_deg_per_s": [k + 0.5, -k] for k, n in enumerate(names)}
        table.assign(**columns).to_csv(folder / "attitudes.csv", index=False)
    return folder


def test_motion_from_tables_round_trip(write_folder, tmp_path):
    block = read_block(with_motion(write_folder(FIX_OFFSET)))
    np.testing.assert_array_equal(block.motion.velocity, [[60, 0.5, -0.1], [61, 0.25, 0.3], [0, 0, 0]])
    np.testing.assert_allclose(np.rad2deg(block.motion.rate), [[0.5, 1.5, 2.5], [0, -1, -2], [0, 0, 0]])
    write_block(block, tmp_path / "copy")
    again = read_block(tmp_path / "copy")
    np.testing.assert_array_equal(again.motion.velocity, block.motion.velocity)
    np.testing.assert_allclose(again.motion.rate, block.motion.rate, rtol=1e-15)


def test_a_flight_is_written_as_tables(fly, tmp_path):
    block = read_block(fly(None, TIMES, "", FIX_OFFSET))
    write_block(block, tmp_path / "copy")
    again = read_block(tmp_path / "copy")
    assert jax.tree.structure(again) == jax.tree.structure(block)
    for field in ("stations", "attitudes", "motion"):
        for a, b in zip(*(jax.tree.leaves(getattr(v, field)) for v in (again, block)), strict=True):
            np.testing.assert_allclose(a, b, rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize(
    "velocity, rate, words",
    [
        (False, False, ["[mounts.default]", "image a", "vX_m_per_s", "stations.csv", '"fixed" at zero']),
        (True, False, ["image a", "rate_right_deg_per_s", "attitudes.csv", "give a [trajectory]"]),
    ],
)
@pytest.mark.parametrize("offset", ['time_offset = "free"', "time_offset_s = 0.01", "time_offset = { sigma_s = 0.01 }"])
def test_a_time_offset_needs_motion(write_folder, velocity, rate, words, offset):
    change = (*FIX_OFFSET[:2], f"[mounts.default]\n{offset}")
    with pytest.raises(BlockError) as caught:
        read_block(with_motion(write_folder(change), velocity, rate))
    for word in words:
        assert word in str(caught.value), str(caught.value)


def test_motion_given_in_part(write_folder):
    folder = with_motion(write_folder())
    (folder / "stations.csv").write_text((folder / "stations.csv").read_text().replace("61.0", ""))
    with pytest.raises(InputError, match=r"stations\.csv, row 3: the motion is given in part; fill in vX_m_per_s"):
        read_block(folder)


def test_a_flight_without_motion_is_still_a_block(write_folder):
    assert dataclasses.replace(read_block(write_folder())).motion is None
