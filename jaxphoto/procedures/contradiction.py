"""Find the group of observations that contradicts all others, and how its values differ from what the others give.

If sigma naught is far too large, the adjustment is distorted, and its residuals and tests name innocent observations.
Here each group in turn loses its weight. If the other observations then agree, its values are compared with those that
the other observations determine:

- positions and control: a shift common to all, a shift along the axes of the aircraft, the order of the exposures, axes
  that are exchanged or have the opposite sign, one value in all rows, or a few wrong rows;
- attitudes: exchanged angles, opposite signs, the zero of the yaw, radians or gon.
"""

import dataclasses
import itertools
import warnings
from collections.abc import Iterator
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.model.numbers import IMAGE_POINTS
from jaxphoto.block import Block
from jaxphoto.errors import JaxphotoError, counted, few
from jaxphoto.observations import AXES, PRIORS, Attitudes, CameraPositions, ControlCoordinates
from jaxphoto.procedures.adjust import adjust
from jaxphoto.rotation import roll_pitch_yaw_from_matrix
from jaxphoto.statistics import physical_residuals
from jaxphoto.statistics.systematic_effects import body_attitudes, flight_speed

# Factor of the standard deviations of a group without weight: its errors may be kilometres.
_WITHOUT = 1e6
# Value of sigma naught up to which the other observations agree.
_AGREE = 3.0
# Ratio of the differences after and before a correction below which it explains them; a correction with fewer changes
# is preferred to one whose differences are smaller by less than the second ratio.
_EXPLAINS, _SIMILAR = 0.2, 1.5
# Minimum ratio of a wrong row to the median difference.
_WRONG_ROW = 20.0


class Contradiction(NamedTuple):
    """Observations without which the others agree."""

    groups: tuple[str, ...]
    """One group, or positions and attitudes of one trajectory."""
    sigma0: float
    """Sigma naught without their weight."""
    others: tuple[str, ...]
    """Further groups, without one of which the others agree, too."""
    explanation: str
    """Correction with which the group agrees with the others; "" if none was found."""


def contradicting_group(adjusted: Adjustment) -> Contradiction | None:
    """Return the group without which the others agree; None if there is none, or none that leaves a datum.

    Positions and attitudes are tested together if neither alone contradicts the others.
    """
    rows = adjusted.block.named_observations
    single = [name for name in rows if name != IMAGE_POINTS and not name.startswith(PRIORS) and rows[name].unit]
    found = [(name, trial) for name in single if (trial := _without(adjusted.block, (name,))) is not None]
    both = (CameraPositions.group, Attitudes.group)
    if not found and set(both) <= set(single) and (trial := _without(adjusted.block, both)) is not None:
        return Contradiction(both, float(trial.sigma0), (), "")
    explained = sorted(((name, trial, _explanation(name, trial)) for name, trial in found), key=lambda e: not e[2])
    if not explained or _agrees(adjust(adjusted.block, explained[0][1].unknowns)):
        # From better initial values all observations agree: the adjustment failed for another reason.
        return None
    (name, trial, words), *rest = explained
    return Contradiction((name,), float(trial.sigma0), tuple(other for other, *_ in rest), words)


def _without(block: Block, groups: tuple[str, ...]) -> Adjustment | None:
    """Adjust without the weight of some groups; None if the others do not agree or determine no datum."""
    rows = block.named_observations
    free = {n: rows[n].with_sigmas_times(np.full(np.shape(rows[n].sigmas), _WITHOUT)) for n in groups}
    try:
        with warnings.catch_warnings(action="ignore"):
            trial = adjust(block.with_observations(free))
    except JaxphotoError:
        return None
    return trial if _agrees(trial) else None


def _agrees(adjusted: Adjustment) -> bool:
    return bool(adjusted.converged) and float(adjusted.sigma0) < _AGREE


def _explanation(name: str, trial: Adjustment) -> str:
    rows = trial.block.named_observations[name]
    if isinstance(rows, Attitudes):
        return _of_attitudes(trial, rows)
    return _of_positions(name, trial, rows) if isinstance(rows, CameraPositions | ControlCoordinates) else ""


class _Correction(NamedTuple):
    words: str
    left: float
    """Root mean square of the differences after the correction."""
    changes: int


def _simplest(corrections: list[_Correction], before: float) -> str:
    """Return the words of the simplest correction that explains the differences; "" if none does."""
    least = min((c.left for c in corrections), default=np.inf)
    good = [c for c in corrections if c.left < _EXPLAINS * before and c.left <= _SIMILAR * least]
    return min(good, key=lambda c: (c.changes, c.left)).words if good else ""


# Positions and control ---------------------------------------------------------------------------------------


def _of_positions(name: str, trial: Adjustment, rows: CameraPositions | ControlCoordinates) -> str:
    block = trial.block
    names = block.images if isinstance(rows, CameraPositions) else block.points
    who = np.unique(np.asarray(rows.who))
    observed = np.full((len(who), 3), np.nan)
    off = observed.copy()
    at = np.searchsorted(who, rows.who), np.asarray(rows.axis)
    observed[at], off[at] = rows.value, physical_residuals(trial)[name]
    whole = np.isfinite(observed).all(axis=1)
    who, observed, off = who[whole], observed[whole], off[whole]
    if len(who) < 4:
        return ""
    corrections = [*_wrong_rows([names[k] for k in who], off), *_common(observed, off)]
    if isinstance(rows, CameraPositions):
        corrections += _of_flight(trial, who, observed, off)
    return _simplest(corrections, _rms(off))


def _wrong_rows(names: list[str], off: Float[np.ndarray, "n 3"]) -> Iterator[_Correction]:
    """Yield the rows that differ far more than the others."""
    size = np.linalg.norm(off, axis=1)
    wrong = size > _WRONG_ROW * np.median(size)
    if 0 < wrong.sum() < len(size) / 2:
        largest = [names[k] for k in np.flatnonzero(wrong)]
        words = f"without {few(largest)}, up to {size.max():.3g} m off: delete or correct them"
        yield _Correction(words, _rms(off[~wrong]), 0)


def _common(observed: Float[np.ndarray, "n 3"], off: Float[np.ndarray, "n 3"]) -> Iterator[_Correction]:
    """Yield a common shift, exchanged or negative axes, and constant columns."""
    shift = np.median(off, axis=0)
    words = f"but for a common shift of {_vector(shift, [f'in {a}' for a in AXES])}: another datum or height reference"
    yield _Correction(words, _rms(off - shift), 1)
    for axis in np.flatnonzero(np.ptp(observed, axis=0) == 0):
        without = np.delete(off, axis, axis=1)
        words = (
            f"but for {AXES[axis]}_m, which is {observed[0, axis]:g} in all rows: give its values, or leave it empty"
        )
        yield _Correction(words, _rms(without), 0)
    computed = observed - off
    for order in itertools.permutations(range(3)):
        for sign in itertools.product((1.0, -1.0), repeat=3):
            changed = observed[:, order] * sign
            if order == (0, 1, 2) and min(sign) > 0:
                continue
            moved = [AXES[k] for k in range(3) if order[k] != k]
            negative = [AXES[k] for k in range(3) if sign[k] < 0]
            changes = [f"{' and '.join(moved)} exchanged"] * bool(moved)
            changes += [f"the opposite sign of {' and '.join(negative)}"] * bool(negative)
            new = changed - computed
            left = _rms(new - np.median(new, axis=0))
            yield _Correction(f"with {' and '.join(changes)}", left, len(moved + negative))


def _of_flight(
    trial: Adjustment, who: np.ndarray, observed: Float[np.ndarray, "n 3"], off: Float[np.ndarray, "n 3"]
) -> Iterator[_Correction]:
    """Yield a shift along the axes of the aircraft, and positions of the exposures before or after."""
    block, unknowns = trial.block, trial.unknowns
    in_body = np.einsum("nij,ni->nj", body_attitudes(block, unknowns)[who], off)
    shift, speed = np.median(in_body, axis=0), flight_speed(block, unknowns)
    text = _vector(shift, ["right", "forward", "up"])
    offset = f" (forward: a time offset of {shift[1] / speed:+.3g} s at {speed:.3g} m/s)" if speed else ""
    words = f"but for a shift along the axes of the aircraft of {text}{offset}: check the clocks and the lever arm"
    yield _Correction(words, _rms(in_body - shift), 1)
    time = np.asarray(block.image_time if block.flight_time is None else block.flight_time)[who]
    for order, step in itertools.product((np.arange(len(who)), np.argsort(time, kind="stable")), (-2, -1, 1, 2)):
        here, there = (order[:-step], order[step:]) if step > 0 else (order[-step:], order[:step])
        left = observed[here] - (observed - off)[there]
        where = f"{counted(abs(step), 'image')} {'after' if step > 0 else 'before'}"
        yield _Correction(f"as those of the {where}: a photograph or an event is missing", _rms(left), 1)


def _vector(values: Float[np.ndarray, "3"], labels: list[str]) -> str:
    """Return the components that are not small compared with the largest."""
    large = [k for k in range(3) if abs(values[k]) > 0.05 * np.abs(values).max()]
    return ", ".join(f"{values[k]:+.3g} m {labels[k]}" for k in large)


# Attitudes ---------------------------------------------------------------------------------------------------


_UNITS = {"": 1.0, "the angles are in radians": 180.0 / np.pi, "the angles are in gon": 0.9}


def _of_attitudes(trial: Adjustment, rows: Attitudes) -> str:
    """Compare with the attitudes that the images have with the stated boresight."""
    block = trial.block
    unknowns = dataclasses.replace(trial.unknowns, mounts=block.start.unknowns.mounts)
    body = body_attitudes(block, unknowns)[np.asarray(rows.image)]
    computed = np.rad2deg(np.asarray(jax.vmap(roll_pitch_yaw_from_matrix)(body)))
    observed = np.rad2deg(np.asarray(rows.roll_pitch_yaw))
    corrections = []
    for (unit, factor), exchanged, sign in itertools.product(
        _UNITS.items(), (False, True), itertools.product((1.0, -1.0), repeat=3)
    ):
        changed = factor * observed[:, [1, 0, 2] if exchanged else [0, 1, 2]] * sign
        off = _wrapped(computed - changed)
        zero = _mean_angle(off)
        names = [f"{a}_deg" for a, s in zip(("roll", "pitch", "yaw"), sign, strict=True) if s < 0]
        words = [unit] * bool(unit) + ["roll_deg and pitch_deg are exchanged"] * exchanged
        words += [f"{' and '.join(names)} {'has' if len(names) == 1 else 'have'} the opposite sign"] * bool(names)
        turned = f"{np.round(zero[2]):+.0f} deg must be added to yaw_deg"
        words += [turned] * bool(abs(zero[2]) > _TURNED_DEG)
        left = _rms(_wrapped(off - zero))
        corrections.append(_Correction(f"if {', and '.join(words)}", left, len(words) + len(names)))
    return _simplest(corrections, _rms(_wrapped(computed - observed)))


# Minimum rotation of the zero of the yaw (degrees) that is not a boresight.
_TURNED_DEG = 10.0


def _wrapped(angle: np.ndarray) -> np.ndarray:
    return (angle + 180.0) % 360.0 - 180.0


def _mean_angle(angle: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "3"]:
    return np.rad2deg(np.angle(np.exp(1j * np.deg2rad(angle)).mean(axis=0)))


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values.size else np.inf
