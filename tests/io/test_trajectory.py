"""Trajectory files: round trips and refusals."""

import struct

import numpy as np
import pytest

from jaxphoto.errors import InputError
from jaxphoto.io.trajectory import (
    FIELDS,
    Records,
    read_flight_csv,
    read_records,
    read_sbet,
    sbet_records,
    with_records,
    write_flight_csv,
    write_sbet,
)

HEADER = "time_s,X_m,Y_m,Z_m,roll_deg,pitch_deg,yaw_deg\n"


def random_sbet(n: int = 12) -> np.ndarray:
    values = np.random.default_rng(4).uniform(-1, 1, (n, len(FIELDS)))
    values[:, 0] = 350_000.1 + np.arange(n) / 200
    return values


def flight(geographic: bool = False, sigmas: bool = True) -> Records:
    rng = np.random.default_rng(5)
    sigma = rng.uniform(0.01, 0.1, (10, 3)) if sigmas else np.full((10, 3), np.nan)
    coordinates = rng.uniform(-80, 80, (10, 3)) if geographic else rng.uniform(-1e6, 7e6, (10, 3))
    angles = rng.uniform(-180, 180, (10, 3))
    return Records("flight.csv", 3e5 + np.arange(10) / 7, coordinates, geographic, angles, sigma, sigma / 3)


def lines(n: int = 10, **changes) -> str:
    return HEADER + "".join(changes.get(f"row{k}", f"{k},{2 * k},0,100,0,0,90\n") for k in range(n))


def test_sbet_round_trip_exactly(tmp_path):
    values = random_sbet()
    write_sbet(values, tmp_path / "flight.sbet")
    assert (tmp_path / "flight.sbet").stat().st_size == 12 * 136
    np.testing.assert_array_equal(read_sbet(tmp_path / "flight.sbet"), values)


def test_sbet_with_other_poses_keeps_all_else():
    values = random_sbet()
    # Counted from the other side of the turn, as records may be.
    values[:, FIELDS.index("longitude")] += 4.0
    records = sbet_records(values, "flight.sbet")
    np.testing.assert_allclose(with_records(values, records), values, atol=1e-13)
    turned = records._replace(roll_pitch_yaw_deg=records.roll_pitch_yaw_deg + 0.5, coordinates=records.coordinates + 2)
    again = sbet_records(with_records(values, turned), "flight.sbet")
    np.testing.assert_allclose(again.coordinates, turned.coordinates, rtol=1e-12)
    west = records._replace(coordinates=records.coordinates - [360.0, 0.0, 0.0])
    np.testing.assert_allclose(with_records(values, west), values, atol=1e-12)
    off = again.roll_pitch_yaw_deg - turned.roll_pitch_yaw_deg
    np.testing.assert_allclose(np.mod(off + 180, 360) - 180, 0.0, atol=1e-11)


def test_sbet_is_seventeen_little_endian_doubles(tmp_path):
    record = [350_000.0, 0.5, -0.8, 1200.0, *[0.0] * 3, 0.01, -0.02, 0.3, 0.1, *[0.0] * 6]
    data = b"".join(struct.pack("<17d", record[0] + k / 200, *record[1:]) for k in range(9))
    (tmp_path / "sbet_1.out").write_bytes(data)
    got = read_records(tmp_path / "sbet_1.out")
    np.testing.assert_allclose(got.coordinates[0], [np.rad2deg(-0.8), np.rad2deg(0.5), 1200.0], rtol=1e-15)
    # Heading 0.3 in axes that wander by 0.1.
    np.testing.assert_allclose(np.deg2rad(got.roll_pitch_yaw_deg[0]), [0.01, -0.02, 0.2], rtol=1e-14)
    assert got.time[1] == 350_000.005
    assert got.geographic and np.isnan(got.sigma_m).all()


def test_sbet_becomes_csv(tmp_path):
    records = sbet_records(random_sbet(), "flight.csv")
    write_flight_csv(records, tmp_path / "flight.csv")
    for a, b in zip(read_records(tmp_path / "flight.csv"), records, strict=True):
        np.testing.assert_array_equal(a, b)


CASES = {
    "short": (lines(8), ["flight.csv", "8 records", "needs 9", "longer"]),
    "order": (lines(row4="2.5,8,0,100,0,0,90\n"), ["flight.csv, row 6", "2.5", "sort"]),
    "week": (lines(row4="-604796,8,0,100,0,0,90\n"), ["row 6", "add 604800"]),
    "turn": (lines(row3="3,6,0,100,0,0,400\n"), ["flight.csv, row 5", "yaw_deg = 400", "unit"]),
    "no number": (lines(row3="3,6,0,100,0,0,east\n"), ["flight.csv, row 5", "yaw_deg", "write it like"]),
    "no columns": (lines().replace("X_m,Y_m", "E,N"), ["flight.csv", "use either X_m", "longitude_deg"]),
    "latitude": (
        lines(row2="2,4,95,100,0,0,90\n").replace("X_m,Y_m,Z_m", "longitude_deg,latitude_deg,height_m"),
        ["flight.csv, row 4", "latitude = 95", "before latitude"],
    ),
}


@pytest.mark.filterwarnings("ignore:.*not used:UserWarning")
@pytest.mark.parametrize("name", CASES)
def test_bad_csv_is_refused(tmp_path, name):
    text, words = CASES[name]
    (tmp_path / "flight.csv").write_text(text)
    with pytest.raises(InputError) as caught:
        read_flight_csv(tmp_path / "flight.csv")
    for word in words:
        assert word in str(caught.value), str(caught.value)


def test_bad_sbet_is_refused(tmp_path):
    path = tmp_path / "flight.sbet"
    with pytest.raises(InputError, match=r"file not found: .*flight\.sbet; add it"):
        read_sbet(path)
    path.write_bytes(b"0" * 300)
    with pytest.raises(InputError, match=r"300 bytes are not a whole number of SBET records of 136 bytes.*Export"):
        read_sbet(path)
    degrees = random_sbet()
    degrees[:, 1] = -25.4
    write_sbet(degrees, path)
    with pytest.raises(InputError, match=r"record 1: a latitude of -25\.4 rad .* Export it again .* radians"):
        read_sbet(path)
    unfinished = random_sbet()
    unfinished[7, 3] = np.nan
    write_sbet(unfinished, path)
    with pytest.raises(InputError, match="record 8: a number is not finite"):
        read_sbet(path)
    backwards = random_sbet()
    backwards[5, 0] -= 1
    with pytest.raises(InputError, match=r"flight\.sbet, record 6: the time .* sort"):
        sbet_records(backwards, "flight.sbet")
