"""What came of recorded positions and attitudes, in sentences."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import scipy
from jaxtyping import Bool, Float

from jaxphoto.errors import counted, few
from jaxphoto.georeferencing.gps import Gps
from jaxphoto.procedures.attitudes_of_photographs import RecordedTurn
from jaxphoto.procedures.level_strip import LEVEL_DEG

# Heights that are all off by the same, to this part of it, count from another zero; by less they jump.
_ALIKE, _ZERO_M = 0.1, 10.0
# Of what they are off in plan.
_BEYOND = 4.0

LEVEL_WORDS = (
    "the positions are those of one line and leave the turn about it open: the photographs are taken to look straight "
    f"down on average, which holds to some {LEVEL_DEG:g} degrees, and heights tilt across the line by as much; "
    "attitudes, a cross strip or control points tell it"
)

_QUARTERS = ("", "turned by 90 degrees to the right", "upside down", "turned by 90 degrees to the left")


def position_words(
    system: str,
    images: Sequence[str],
    known: Mapping[str, Gps],
    offsets: Float[np.ndarray, "n 3"],
    used: Bool[np.ndarray, "n"],
    sigma: Float[np.ndarray, "n 3"],
) -> Iterator[str]:
    """How the `known` positions of the `images` agree with the network: offsets recorded minus network (m)."""
    n, stated = len(known), [g.stated_sigma_m is not None for g in known.values()]
    plan, height = np.hypot(*offsets[used, :2].T), np.abs(offsets[used, 2])
    yield (
        f"{used.sum()} of {n} positions agree with the network: medians {np.median(plan):.2g} m in plan, "
        f"{np.median(height):.2g} m in height; map system {system}"
    )
    if without := [name for name in images if name not in known]:
        have, follow = ("have", "follow") if len(without) > 1 else ("has", "follows")
        yield (
            f"{counted(len(without), 'photograph')} {have} no position with a height, and {follow} from the others "
            f"({few(without)})"
        )
    if any(stated):
        yield f"standard deviations of {sum(stated)} positions are those of their files"
    if not all(stated):
        east, _, up = sigma[stated.index(False)]
        yield (
            f"{stated.count(False)} files do not say how good their positions are: {east:.2g} m east and north, "
            f"{up:.2g} m up are taken to begin with"
        )
    names = np.array(list(known), object)
    high = ~used & _of_another_zero(offsets, used)
    if high.any():
        yield (
            f"the heights of {high.sum()} photographs ({few(names[high].tolist())}) are all "
            f"{np.median(offsets[high, 2]):+.0f} m from those of the others: they count from another zero, such as "
            "take-off, and are left out"
        )
    for name, off in zip(names[~used & ~high], offsets[~used & ~high], strict=True):
        told = ", ".join(f"{v:z.1f}" for v in off)
        yield f"the position of {name} contradicts the others by {told} m (east, north, up) and is left out"


def _of_another_zero(offsets: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Which of those left out, two or more, are off in height alone, and all by the same."""
    plan = np.hypot(*offsets[:, :2].T)
    level = ~used & (np.abs(offsets[:, 2]) > np.maximum(_ZERO_M, _BEYOND * plan))
    if level.sum() < 2:
        return np.zeros(len(offsets), bool)
    middle = float(np.median(offsets[level, 2]))
    alike = level & (np.abs(offsets[:, 2] - middle) <= max(_ALIKE * abs(middle), 2 * _ALIKE * _ZERO_M))
    return alike if alike.sum() >= 2 else np.zeros(len(offsets), bool)


def attitude_words(recorded: RecordedTurn | str | None, used: bool, turn: Float[np.ndarray, "3 3"]) -> Iterator[str]:
    """How recorded attitudes agree with the network and its `turn` to the map, and whether they are observed."""
    if isinstance(recorded, str):
        yield recorded
    if not isinstance(recorded, RecordedTurn):
        return
    apart = np.rad2deg(np.linalg.norm(scipy.spatial.transform.Rotation.from_matrix(turn @ recorded.turn.T).as_rotvec()))
    scatter, boresight = np.rad2deg([recorded.scatter_rad, recorded.turn_sigma_rad])
    words = f"{len(recorded.image)} recorded attitudes agree with one another to {scatter:.2g} degrees"
    if recorded.quarters:
        yield (
            f"the pictures lie {_QUARTERS[recorded.quarters]} against the attitudes of their files, as the positions "
            "show: these are turned likewise"
        )
    if used:
        yield (
            f"{words}; positions do not tell the turn of the block as well: they are observed, with what they have in "
            f"common known to {boresight:.2g} degrees"
        )
    else:
        digits = f"{apart:.0f}" if apart >= 10 else f"{apart:.2g}"
        yield f"{words} and with the positions to {digits}; the positions tell the turn better: they are not used"
    if recorded.left_out:
        yield f"the attitudes of {few(list(recorded.left_out))} contradict the others and are left out"
