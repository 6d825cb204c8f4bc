"""GNSS/IMU trajectories from CSV and Applanix SBET, and back (docs/georeferencing.md)."""

from pathlib import Path

from jaxphoto.io.trajectory.flight_csv import read_flight_csv, write_flight_csv
from jaxphoto.io.trajectory.records import Records
from jaxphoto.io.trajectory.sbet import FIELDS, read_sbet, sbet_records, with_records, write_sbet

__all__ = [
    "FIELDS", "Records", "is_sbet", "read_flight_csv", "read_records", "read_sbet", "sbet_records", "with_records",
    "write_flight_csv", "write_moved", "write_sbet",
]  # fmt: skip


def is_sbet(path: Path) -> bool:
    """Whether a trajectory is called as SBET are: .sbet, or .out (POSPac's ending)."""
    return path.suffix.lower() in (".sbet", ".out")


def write_moved(moved: Records, given: Path, folder: Path) -> None:
    """trajectory.csv; and where `given`, of which `moved` are all records elsewhere, is an SBET, one by its name."""
    write_flight_csv(moved, folder / "trajectory.csv")
    if is_sbet(given):
        write_sbet(with_records(read_sbet(given), moved), folder / given.name)


def read_records(path: Path) -> Records:
    """The records of a trajectory: SBET where the file is called so, CSV otherwise."""
    if is_sbet(path):
        return sbet_records(read_sbet(path), path.name)
    return read_flight_csv(path)
