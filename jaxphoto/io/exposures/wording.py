"""What came of a file of exposures, in words."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Int

from jaxphoto.errors import few
from jaxphoto.georeferencing.exposure_times import ZONES_S, Ambiguous, Matched, clock_words
from jaxphoto.georeferencing.gps import Fix
from jaxphoto.io.exposures.joining import FINE_S, Clock, distance
from jaxphoto.io.exposures.records import Exposures
from jaxphoto.io.photographs import Photograph

# Differences of clocks (s) that need no word: EXIF counts seconds, and notes them when it is written.
_SMALL_S = 1.5


def joined_words(
    photographs: Sequence[Photograph], file: Exposures, found: Matched, clock: Clock, how: str = "by time"
) -> str:
    """How many photographs a file gives positions to, what is missing or left over, and how its clock differs."""
    words = f"positions of {counts(photographs, file, found.exposure)} {how}{fixes(file, found.exposure)}"
    if not np.isfinite(found.offset_s):
        return words
    small = _SMALL_S if clock.tolerance_s > FINE_S else FINE_S
    if clock.gps and abs(found.offset_s) <= small:
        return words
    differ = f"the clocks of photographs and file differ by {clock_words(found.offset_s)}"
    if abs(found.offset_s) > ZONES_S:
        near = distance(photographs, file, found.exposure)
        return f"{words}; {differ}; positions agree to {near:.1f} m: leave the file out if it is of another day"
    return f"{words}; {differ}, which is taken off"


def why_not(result: Ambiguous | None) -> str:
    """Why times join nothing."""
    if result is None:
        return "no two photographs have times that differ from its times by one constant; not used"
    one, other = map(clock_words, result.offsets_s)
    return (
        f"{result.fitted} photographs fit its times as well with clocks that differ by {one} as by {other}, and no "
        "position tells which; not used (a table with names does it: --exposures)"
    )


def counts(photographs: Sequence[Photograph], file: Exposures, exposure: Int[np.ndarray, "n"]) -> str:
    """How many photographs have an exposure; which have none, and which rows of the file have no photograph."""
    used = set(exposure[exposure >= 0].tolist())
    without = [p.name for p, k in zip(photographs, exposure, strict=True) if k < 0]
    surplus = [str(row) for k, row in enumerate(file.rows.tolist()) if k not in used]
    parts = [f"none for {few(without)}"] if without else []
    if surplus:
        rows = "row" if len(surplus) == 1 else "rows"
        parts.append(f"{len(surplus)} of its exposures without a photograph, {rows} {few(surplus)}")
    more = f" ({'; '.join(parts)})" if parts else ""
    return f"{len(used)} of {len(photographs)} photographs{more}"


def fixes(file: Exposures, exposure: Int[np.ndarray, "n"]) -> str:
    """How many solutions are of which kind."""
    return _counted([file.fix[k] for k in exposure if k >= 0])


def said_by_own_files(photographs: Sequence[Photograph]) -> list[str]:
    """What packets of photographs say besides positions, and of how many where not of all: a sentence or none."""
    at = [p.gps for p in photographs if p.gps]
    said = {
        "attitudes": [p.attitude is not None for p in photographs],
        "heights above take-off": [p.above_takeoff_m is not None for p in photographs],
        "standard deviations of positions": [g.sigma_m is not None for g in at],
    }
    parts = [f"{what}{_of_all(have)}" for what, have in said.items() if any(have)]
    solutions = _counted([g.fix for g in at])
    if solutions:
        parts.append(f"solutions{solutions.replace(',', ':', 1)}")
    return [f"the photographs' own files tell {', '.join(parts)}"] if parts else []


def _of_all(have: Sequence[bool]) -> str:
    return "" if all(have) else f" ({sum(have)} of {len(have)})"


def _counted(kinds: Sequence[Fix]) -> str:
    parts = [f"{kinds.count(kind)} {kind}" for kind in ("fixed", "float", "single", "integrated") if kind in kinds]
    return f", {', '.join(parts)}" if parts else ""
