"""surfaces.csv and [scanner]: points on the surfaces of a laser scanner, its boresight and the shifts of its strips."""

from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from jaxphoto.arrays import on_device
from jaxphoto.block import Block
from jaxphoto.errors import quoted
from jaxphoto.georeferencing import Scanner
from jaxphoto.io.block_folder.camera_section import status
from jaxphoto.io.block_folder.image_points import ObservedPoints
from jaxphoto.io.block_folder.section import Section
from jaxphoto.io.block_folder.table_layout import FOOT, NORMAL, TURN
from jaxphoto.io.text_tables import Table
from jaxphoto.observations import SurfaceRows

_DEG = np.pi / 180
# By how much the length of a normal may miss 1: more than rounding of a few written digits.
_UNIT = 1e-3


class Surfaces(NamedTuple):
    """Observed points on surfaces, and the scanner's start and priors; None where the block has no scanner."""

    rows: SurfaceRows
    scanner: Scanner | None
    priors: Scanner | None


def read_surfaces(table: Table, section: Section, points: ObservedPoints) -> Surfaces:
    """All of it in the object frame, whatever the frame of other files."""
    section.known("boresight_deg", "boresight", "shifts")
    shifts = section.section("shifts")
    point = points.find(table.ids("point"))
    for line in np.flatnonzero(point < 0):
        name = table.text("point")[line]
        raise table.misfit(line, f"point {name} is measured in no image; measure it or delete the row")
    foot, normal, turn = (np.stack([table.numbers(n) for n in names], axis=1) for names in (FOOT, NORMAL, TURN))
    sigma, length = table.sigmas("sigma_m"), np.linalg.norm(normal, axis=1)
    for line in np.flatnonzero(np.isnan(sigma)):
        raise table.bad(line, "sigma_m is empty; give the standard deviation of the surface")
    for line in np.flatnonzero(np.abs(length - 1) > _UNIT):
        raise table.bad(line, f"the normal has the length {length[line]:.4f}; give a unit vector")
    named, names = table.text("strip"), tuple(shifts)
    for line in np.flatnonzero([bool(names) and name not in names for name in named]):
        raise table.misfit(
            line, f"strip {quoted(named[line])} has no table; add [scanner.shifts.{named[line]}] to {section.file}"
        )
    strip = np.array([names.index(name) if names else 0 for name in named], int)
    rows = SurfaceRows(point, strip, *map(on_device, (foot, normal, turn, sigma)))
    if not section.values:
        return Surfaces(rows, None, None)
    boresight = section.vector("boresight_deg") * _DEG
    start, priors = {}, {}
    for name in names:
        own = shifts.section(name)
        own.known("shift_m", "shift")
        shift = own.vector("shift_m")
        start[name], priors[name] = on_device(shift), own.prior("shift", shift, "_m")
    return Surfaces(
        rows,
        Scanner(on_device(boresight), start),
        Scanner(section.prior("boresight", boresight, "_deg", _DEG), priors),  # type: ignore[arg-type]
    )


def scanner_section(scanner: Scanner | None, priors: Scanner | None) -> dict[str, Any]:
    """The [scanner] table that `read_surfaces` reads as `scanner`; empty without one."""
    if scanner is None or priors is None:
        return {}
    return {
        "boresight_deg": (np.asarray(scanner.boresight) / _DEG).tolist(),
        "boresight": status(priors.boresight, scanner.boresight, _DEG),
        "shifts": {
            name: {"shift_m": np.asarray(shift).tolist(), "shift": status(priors.shifts[name], shift)}
            for name, shift in scanner.shifts.items()
        },
    }


def surface_table(block: Block) -> pd.DataFrame:
    """The content of surfaces.csv."""
    rows, scanner = block.surfaces, block.start.unknowns.scanner
    names = np.array(tuple(scanner.shifts) if scanner is not None and scanner.shifts else ("",), object)
    vectors = ((FOOT, rows.foot), (NORMAL, rows.normal), (TURN, rows.turn))
    columns = {name: np.asarray(v)[:, k] for of, v in vectors for k, name in enumerate(of)}
    table = {"point": np.array(block.points, object)[rows.point], **columns, "sigma_m": np.asarray(rows.sigma)}
    return pd.DataFrame(table | ({"strip": names[rows.strip]} if names.any() else {}))
