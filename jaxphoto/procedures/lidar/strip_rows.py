"""Observations of a strip adjustment: planes of two strips, and steps of trajectory errors."""

from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Float, Int

from jaxphoto.georeferencing import StripErrors, StripSpline
from jaxphoto.lidar.correction import ScannerPath, in_portions, scanner_motions, scanner_poses
from jaxphoto.lidar.corresponding_planes import PlanePairs, StripPatches, steep
from jaxphoto.lidar.strip_correction import corrected_strip
from jaxphoto.lidar.strip_settings import StripSettings
from jaxphoto.observations import AttitudeSteps, PositionSteps, StripPlanes
from jaxphoto.procedures.lidar.strip_unknowns import KnotSigmas
from jaxphoto.rotation import roll_pitch_yaw_from_matrix

# Iterations from a corrected point to the measured one: each reduces the error by a factor of the corrections' size.
_STEPS = 2
# Odd multiplier (Knuth) that scatters neighbouring integers over 64 bits.
_SCATTER = np.uint64(0x9E3779B97F4A7C15)


class Side(NamedTuple):
    """One strip's part of rows: knots (n, 4), weights (n, 4), all others (n, 3)."""

    knots: np.ndarray
    weights: np.ndarray
    point: np.ndarray
    scanner: np.ndarray
    roll_pitch_yaw: np.ndarray
    velocity: np.ndarray
    rate: np.ndarray


def side_of(
    patches: StripPatches,
    which: Int[np.ndarray, "n"],
    foot: Float[np.ndarray, "n 3"],
    strip: int,
    errors: StripErrors,
    path: ScannerPath | None,
) -> Side:
    """Return the places `foot` (m, corrected by `errors`) of patches as measured, and the scanner poses."""
    time = patches.time[which]
    knots, weights = errors.splines[strip].weights(time)
    point = foot + patches.measured[which] - patches.mean[which]
    for _ in range(_STEPS):
        point = point - (corrected_strip(point, time, strip, errors, path) - foot)
    if path is None or not len(time):
        # From vertically above: nothing that rotates the shot is estimated.
        none = np.zeros_like(point)
        return Side(knots, weights, point, point + np.array([0.0, 0.0, 1.0]), none, none, none)
    poses = scanner_poses(path, time)
    angles = in_portions(_angles, (poses.object_from_body,))
    return Side(knots, weights, point, poses.position, angles, *scanner_motions(path, time))


def plane_rows(pairs: PlanePairs, a: Side, b: Side) -> StripPlanes:
    """Return planes common to two strips as observations."""
    of_a = {f"{name}_a": v for name, v in a._asdict().items()}
    of_b = {f"{name}_b": v for name, v in b._asdict().items()}
    return StripPlanes(**of_a, **of_b, normal=pairs.normal, sigma=pairs.sigma, gap=np.zeros(len(pairs.gap)))


def thinned(normal: Float[np.ndarray, "n 3"], cell: Int[np.ndarray, "n"], most: int) -> np.ndarray:
    """Select at most `most` planes: half of them steep ones if possible, otherwise at random.

    Randomness depends on the cell, so that nearly equal planes give the same selection.
    """
    tells = steep(normal)
    order = np.argsort(cell.astype(np.uint64) * _SCATTER, kind="stable")
    parts = order[tells[order]], order[~tells[order]]
    first = min(len(parts[0]), max(most // 2, most - len(parts[1])))
    return np.sort(np.concatenate([parts[0][:first], parts[1][: most - first]]))


def step_rows(
    splines: tuple[StripSpline, ...], sigmas: KnotSigmas, settings: StripSettings
) -> tuple[PositionSteps, AttitudeSteps]:
    """Return steps from knot to knot of every strip, so that every knot has its a priori standard deviation."""
    start = np.concatenate([s.first + np.arange(s.size - 1) for s in splines])
    apart = np.concatenate([np.full(s.size - 1, s.interval) for s in splines])
    kept = np.exp(-apart / settings.correlation_s)
    part, none = kept[:, None] ** 2, np.zeros((len(start), 3))

    def new(sigma: Float[np.ndarray, "knots 3"]) -> Float[np.ndarray, "steps 3"]:
        # If errors decrease faster than their correlation decays, new variance still enters.
        before, after = sigma[start] ** 2, sigma[start + 1] ** 2
        return np.sqrt(np.maximum(after - part * before, (1 - part) * np.minimum(before, after)))

    return (
        PositionSteps(start, start + 1, kept, new(sigmas.position), none),
        AttitudeSteps(start, start + 1, kept, new(sigmas.attitude), none),
    )


_angles = eqx.filter_jit(jax.vmap(roll_pitch_yaw_from_matrix))
