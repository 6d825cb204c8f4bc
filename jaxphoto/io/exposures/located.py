"""Photographs with all that their files and those beside them say of where they were taken."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from jaxphoto.errors import InputError, shown
from jaxphoto.georeferencing.gps import Heights
from jaxphoto.georeferencing.recorded_positions import one_height, plausible_positions
from jaxphoto.io.exposures.assigned import Arm, Assigned, with_exposures
from jaxphoto.io.exposures.marks import read_marks
from jaxphoto.io.exposures.records import Exposures
from jaxphoto.io.exposures.rtklib import read_pos
from jaxphoto.io.exposures.sbet import read_sbet_exposures
from jaxphoto.io.exposures.sound_rows import of_sound_rows
from jaxphoto.io.exposures.table import read_table
from jaxphoto.io.exposures.wording import said_by_own_files
from jaxphoto.io.photographs import Photograph

_SUFFIXES = (".mrk", ".pos", ".sbet")
_TABLES = ("exposures.csv", "geo.txt")


def located(
    photographs: Sequence[Photograph],
    folders: Sequence[Path] = (),
    given: Sequence[Path] = (),
    *,
    code: int | None = None,
    arm: Arm | None = None,
    heights: Heights | int | None = None,
) -> Assigned:
    """The photographs where the files `given` and those in `folders` say they were taken, with heights above one thing.

    `code` is the EPSG system of map coordinates in tables, `arm` the lever arm from camera to antenna (m: right,
    forward, up of the aircraft), `heights` says above what the heights are that do not say it themselves; "take-off"
    takes those above it, an EPSG code of heights adds its geoid. Every source has a sentence, and so has every file in
    a folder that cannot be read. Raises InputError for such a file that is given, and for a geoid that is not at hand.
    """
    kind: Heights = "geoid" if isinstance(heights, int) else heights or "unknown"
    files, said = [read_exposures(path, code, kind) for path in given], []
    known = {path.resolve() for path in given}
    for path in (path for folder in folders if folder.is_dir() for path in exposure_files(folder)):
        if path.resolve() in known:
            continue
        try:
            files.append(read_exposures(path, code, kind))
        except InputError as error:
            said.append(f"{error}; the file is not used")
    assigned = with_exposures(photographs, files, arm)
    taken = assigned.photographs
    positions, mended = plausible_positions({p.name: p.gps for p in taken})
    positions, told = one_height(positions, {p.name: p.above_takeoff_m for p in taken}, heights)
    sentences = [*said, *assigned.sentences, *mended, *said_by_own_files(photographs), *told]
    return Assigned([p._replace(gps=positions[p.name]) for p in taken], list(map(shown, sentences)))


def read_exposures(path: Path, code: int | None = None, heights: Heights = "unknown") -> Exposures:
    """The exposures or the trajectory of one file, by its ending: .MRK, .pos, .sbet or .out, else a table.

    `code` is the EPSG system of a table's map coordinates, `heights` what its heights are above. Rows of text that are
    wrong are left out, which `Exposures.why` says. Raises InputError, naming file and row, where half of them are.
    """
    suffix = path.suffix.lower()
    if suffix in (".sbet", ".out"):
        return read_sbet_exposures(path)
    if suffix == ".mrk":
        return of_sound_rows(path, partial(read_marks, path))
    if suffix == ".pos":
        return of_sound_rows(path, partial(read_pos, path))
    return of_sound_rows(path, partial(read_table, path, code, heights))


def exposure_files(folder: Path) -> list[Path]:
    """The files of a folder that say where its photographs were exposed: .MRK, .pos, .sbet, exposures.csv and
    geo.txt."""
    found = (f for f in folder.iterdir() if f.suffix.lower() in _SUFFIXES or f.name.lower() in _TABLES)
    # Hidden ones are those that macOS has beside each file.
    return sorted(f for f in found if f.is_file() and not f.name.startswith("."))
