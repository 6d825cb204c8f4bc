"""The observations of a strip adjustment: planes of two strips, and how a trajectory's error goes on."""

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

# Steps towards the measured point of a corrected one: each leaves a part of it as small as the corrections are.
_STEPS = 2
# An odd multiplier (Knuth) that scatters neighbouring numbers over all of 64 bits.
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
    """The places `foot` (m, corrected by `errors`) of patches of a strip as it measured them, and from where."""
    time = patches.time[which]
    knots, weights = errors.splines[strip].weights(time)
    point = foot + patches.measured[which] - patches.mean[which]
    for _ in range(_STEPS):
        point = point - (corrected_strip(point, time, strip, errors, path) - foot)
    if path is None or not len(time):
        # From straight above: nothing that would turn the shot is estimated.
        none = np.zeros_like(point)
        return Side(knots, weights, point, point + np.array([0.0, 0.0, 1.0]), none, none, none)
    poses = scanner_poses(path, time)
    angles = in_portions(_angles, (poses.object_from_body,))
    return Side(knots, weights, point, poses.position, angles, *scanner_motions(path, time))


def plane_rows(pairs: PlanePairs, a: Side, b: Side) -> StripPlanes:
    """The planes that two strips have in common, as observations."""
    of_a = {f"{name}_a": v for name, v in a._asdict().items()}
    of_b = {f"{name}_b": v for name, v in b._asdict().items()}
    return StripPlanes(**of_a, **of_b, normal=pairs.normal, sigma=pairs.sigma, gap=np.zeros(len(pairs.gap)))


def thinned(normal: Float[np.ndarray, "n 3"], cell: Int[np.ndarray, "n"], most: int) -> np.ndarray:
    """Which planes to take where there are more than `most`: half of them steep ones if there are, else by chance.

    Chance is the cell's, so that the same are taken of nearly the same planes.
    """
    tells = steep(normal)
    order = np.argsort(cell.astype(np.uint64) * _SCATTER, kind="stable")
    parts = order[tells[order]], order[~tells[order]]
    first = min(len(parts[0]), max(most // 2, most - len(parts[1])))
    return np.sort(np.concatenate([parts[0][:first], parts[1][: most - first]]))


def step_rows(
    splines: tuple[StripSpline, ...], sigmas: KnotSigmas, settings: StripSettings
) -> tuple[PositionSteps, AttitudeSteps]:
    """From knot to knot of every strip, so that every knot has its own standard deviation beforehand."""
    start = np.concatenate([s.first + np.arange(s.size - 1) for s in splines])
    apart = np.concatenate([np.full(s.size - 1, s.interval) for s in splines])
    kept = np.exp(-apart / settings.correlation_s)
    part, none = kept[:, None] ** 2, np.zeros((len(start), 3))

    def new(sigma: Float[np.ndarray, "knots 3"]) -> Float[np.ndarray, "steps 3"]:
        # Where errors become smaller faster than they are forgotten something new comes in all the same.
        before, after = sigma[start] ** 2, sigma[start + 1] ** 2
        return np.sqrt(np.maximum(after - part * before, (1 - part) * np.minimum(before, after)))

    return (
        PositionSteps(start, start + 1, kept, new(sigmas.position), none),
        AttitudeSteps(start, start + 1, kept, new(sigmas.attitude), none),
    )


_angles = eqx.filter_jit(jax.vmap(roll_pitch_yaw_from_matrix))
