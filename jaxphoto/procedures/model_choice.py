"""Choose the distortion model of a block: cross-validation, information criteria and significance.

Every candidate (a model with some coefficients estimated, others fixed at 0) is adjusted to all observations and to the
block without each of k folds. All use residuals of *measured* image coordinates. Every object point keeps at least two
rays when a fold is omitted. Omitted image points are predicted from the other observations.

Orientations and points are estimated with every candidate and increase with the block: they are not part of the choice.
For the camera there remain

    N = observations + constraints - unknowns other than interior ones = redundancy + p

degrees of freedom. A candidate with p interior unknowns and the variance factor leaves S = v'Pv unexplained:

    AIC = N ln(S / N) + 2 (p + 1),    AICc = AIC + 2 (p + 1)(p + 2) / (N - p - 2),    BIC = N ln(S / N) + (p + 1) ln N
    F   = (S_smaller - S) / (p - p_smaller) / (S / redundancy)    of a candidate and one that it contains

Counting all unknowns would replace S / N by S / n and favour large models, as n is often twice N. Sources: Burnham and
Anderson (2002), Model selection; residual likelihood: Patterson and Thompson (1971).
"""

import dataclasses
from collections.abc import Callable, Iterable
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
import scipy
from jaxtyping import Bool, Float, Int

from jaxphoto.adjustment import Adjustment, PaddedSizes, common_sizes
from jaxphoto.arrays import as_jax_array, to_numpy
from jaxphoto.block import Block, bent_cameras
from jaxphoto.camera import AbstractDistortion, InteriorOrientation, Sensor, exact, get_parameter, set_parameter
from jaxphoto.camera.conversion import fitted
from jaxphoto.collinearity import ExteriorOrientation, image_residual
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import BlockError, DatumError, InputError, RankError
from jaxphoto.georeferencing import apparent_point
from jaxphoto.observations import ImagePoints
from jaxphoto.procedures.adjust import adjust
from jaxphoto.procedures.weights import estimate_weights
from jaxphoto.statistics import Significance, VarianceComponents, covariance, significance
from jaxphoto.unknowns import FIXED, FREE, Unknowns, Weighted


class Candidate(NamedTuple):
    """Distortion model of which only `free` is estimated; its other coefficients are fixed at 0."""

    name: str
    distortion: type[AbstractDistortion]
    free: tuple[str, ...]

    def within(self, other: "Candidate") -> bool:
        """Return True if `other` is the same model with additional coefficients."""
        return self.distortion is other.distortion and set(self.free) < set(other.free)


def candidate_of(text: str) -> Candidate:
    """Parse `brown` (its usual coefficients), `brown:all`, `brown:none` or `brown:k1+k2`.

    Raises InputError for an unknown model or coefficient.
    """
    model, _, listed = text.strip().partition(":")
    kind = AbstractDistortion.called(model)
    estimable = tuple(name for name in kind.coefficients if name not in kind.scales)
    if listed in ("", "all"):
        return Candidate(text.strip(), kind, estimable if listed else kind.usual())
    names = () if listed == "none" else tuple(name.strip() for name in listed.split("+"))
    for name in names:
        if name not in estimable:
            raise InputError(f"{text}: {name!r} is not estimable in {model}; choose among {', '.join(estimable)}")
    return Candidate(text.strip(), kind, tuple(name for name in estimable if name in names))


def with_candidate(block: Block, candidate: Candidate, unknowns: Unknowns | None) -> Block:
    """Return the block with the candidate for all cameras, starting at `known` orientations and points if given.

    c, x_p and y_p keep their priors: a weighted value is transformed if the conversion to another model changes it, as
    for c of SMAC with R0. All coefficients of the candidate are free, even weighted ones: otherwise models with a prior
    would explain an additional observation. Their initial values come from the block's distortion, converted if its
    model differs. Residuals are of measured coordinates, for every model.
    """
    interior, priors = {}, {}
    for name, camera in block.start.unknowns.interior.items():
        interior[name] = _start(camera, candidate, block.sensors[name])
        priors[name] = _priors(camera, block.priors.interior[name], interior[name], candidate.free)
    block = eqx.tree_at(lambda b: (b.start.unknowns.interior, b.priors.interior), block, (interior, priors))
    if unknowns is None:
        return block
    places = lambda b: (b.start.unknowns.exterior, b.start.unknowns.points)  # noqa: E731
    block = eqx.tree_at(places, block, (unknowns.exterior, unknowns.points))
    everything = (np.ones(len(block.images), bool), np.ones(len(block.points), bool))
    return eqx.tree_at(lambda b: (b.start.image_known, b.start.point_known), block, everything)


def _start(camera: InteriorOrientation, candidate: Candidate, sensor: Sensor) -> InteriorOrientation:
    kind = candidate.distortion
    fixed = tuple(name for name in kind.coefficients if name not in candidate.free)
    try:
        same = exact(camera, kind)
        # The fit needs the fixed coefficients: rational terms depend on each other.
        interior = same if same is not None else fitted(camera, kind, sensor, fixed).interior
    except ValueError:
        # A candidate that cannot approximate the given distortion starts at zero distortion.
        interior = dataclasses.replace(camera, distortion=kind.plain(sensor))
    interior = dataclasses.replace(interior, residuals="measured")
    for name in fixed:
        interior = set_parameter(interior, name, 0.0)
    return jax.tree.map(as_jax_array, interior)


def _priors(camera: InteriorOrientation, priors, interior: InteriorOrientation, free: tuple[str, ...]):
    """Return priors of the candidate, whose camera `interior` was converted from `camera`."""
    new = jax.tree.map(lambda _: FIXED, interior)
    scale = float(interior.c) / float(camera.c)
    for name, factor in (("c_mm", scale), ("xp_mm", 1.0), ("yp_mm", 1.0)):
        prior = get_parameter(priors, name)
        if isinstance(prior, Weighted):
            # Retain the distance of the prior from the initial value, in the converted unit of c.
            start, before = (float(get_parameter(one, name)) for one in (interior, camera))
            prior = Weighted(start + factor * (float(prior.value) - before), factor * float(prior.sigma))
        new = set_parameter(new, name, prior)
    for name in free:
        new = set_parameter(new, name, FREE)
    return new


_LEAST_RAYS = 2


def folds(block: Block, k: int, seed: int = 0) -> Int[np.ndarray, "rows"]:
    """Return the fold (0 ... k - 1) in which each image row is omitted; -1 for rows that are never omitted.

    The rows of each point are distributed over the folds in random order. Each point keeps at least two rays when a
    fold is omitted. Raises BlockError if no point was measured in three images.
    """
    point = np.asarray(block.image_points.point)
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(point))
    order = order[np.argsort(point[order], kind="stable")]
    rays = np.bincount(point, minlength=len(block.points))
    first = np.concatenate([[0], np.cumsum(rays)[:-1]])
    place = np.arange(len(order)) - first[point[order]]
    turn = rng.integers(0, k, len(block.points))
    fold = np.full(len(point), -1)
    # Row number place // k of its fold: at least `_LEAST_RAYS` rows are outside the fold.
    allowed = place // k < rays[point[order]] - _LEAST_RAYS
    fold[order] = np.where(allowed, (place + turn[point[order]]) % k, -1)
    if not (fold >= 0).any():
        raise BlockError("no point was measured in three images: no image point can be omitted; measure more rays")
    return fold


def without_rows(block: Block, left_out: Bool[np.ndarray, "rows"]) -> Block:
    """Remove some image points of the block."""
    selected, p = ~left_out, block.image_points
    rows = ImagePoints(p.image[selected], p.point[selected], to_numpy(p.xy)[selected], to_numpy(p.sigma)[selected])
    return dataclasses.replace(block, image_points=rows)


def fold_blocks(block: Block, fold: Int[np.ndarray, "rows"]) -> tuple[list[Block], PaddedSizes]:
    """Return the block without each of the folds, and sizes that fit these and the block itself."""
    parts = [without_rows(block, fold == k) for k in range(fold.max() + 1)]
    return parts, common_sizes([block, *parts])


def measured_discrepancies(block: Block, unknowns: Unknowns) -> Float[np.ndarray, "rows 2"]:
    """Return measured minus predicted image coordinates (mm) of every image row, whatever the domain of the distortion.

    These are the "measured" residuals of `InteriorOrientation`, so all models are compared by the same quantity.
    """
    p = block.image_points
    discrepancies = np.zeros((len(p.image), 2))
    camera = np.array(block.image_camera, object)[p.image]
    positions, matrices = (to_numpy(v) for v in (unknowns.exterior.position, unknowns.exterior.camera_from_object))
    bent = bent_cameras(block, unknowns)
    for name, interior in unknowns.interior.items():
        rows_of_camera = np.flatnonzero(camera == name)
        if len(rows_of_camera):
            image, point = p.image[rows_of_camera], p.point[rows_of_camera]
            exterior = ExteriorOrientation(positions[image], matrices[image])
            camera_of_row = interior if bent is None else jax.tree.map(lambda v: to_numpy(v)[image], bent[name])  # noqa: B023
            numbers = jax.tree.map(
                lambda v: np.asarray(v, float), dataclasses.replace(camera_of_row, residuals="measured")
            )
            rows = (exterior, to_numpy(unknowns.points)[point], to_numpy(p.xy)[rows_of_camera])
            discrepancies[rows_of_camera] = call_compiled(
                _discrepancies, numbers, *rows, block.corrections, bent is not None
            )
    return discrepancies


@eqx.filter_jit
def _discrepancies(interior, exterior, points, xy, corrections, by_row: bool):
    def of_one(interior, exterior, point, xy):
        aim = apparent_point(exterior.position, point, corrections)
        return image_residual(interior, exterior, aim, xy)

    return jax.vmap(of_one, (0 if by_row else None, 0, 0, 0))(interior, exterior, points, xy)


FOLDS = 5
_NAN = float("nan")


class Judged(NamedTuple):
    """Result of a candidate; values are NaN and `problem` is the reason if it could not be adjusted.

    `rms_px` and `cv_rms_px` are the RMS length of the image discrepancy (both axes) of adjusted and of omitted image
    points. `cv_excess` is the mean square discrepancy of omitted image points minus the smallest one of all candidates,
    in standard errors of the differences by image point.
    """

    candidate: Candidate
    problem: str = ""
    n_parameters: int = 0
    n_effective: int = 0
    redundancy: int = 0
    sum_of_squares: float = _NAN
    rms_px: float = _NAN
    cv_rms_px: float = _NAN
    cv_excess: float = _NAN
    aic: float = _NAN
    aicc: float = _NAN
    bic: float = _NAN
    smaller: str = ""
    """Largest candidate contained in this one, compared by the F test."""
    f: float = _NAN
    f_p: float = _NAN
    parameters: tuple[Significance, ...] = ()

    @property
    def sigma0(self) -> float:
        """Return sigma0 of residuals of measured coordinates."""
        return float(np.sqrt(self.sum_of_squares / self.redundancy)) if self.redundancy > 0 else _NAN

    @property
    def weakest(self) -> Significance | None:
        """Return the estimated distortion coefficient with the smallest ratio to its standard deviation."""
        coefficients = [s for s in self.parameters if s.parameter in self.candidate.free]
        return min(coefficients, key=lambda s: s.ratio, default=None)


class ModelChoice(NamedTuple):
    """Results of all candidates, in the order given; `by_bic` and `by_prediction` are names, "" if none converged.

    `by_prediction` is the candidate with the fewest parameters whose prediction error is within one standard error of
    the smallest.
    """

    judged: tuple[Judged, ...]
    n_left_out: int
    by_bic: str
    by_prediction: str
    weights: VarianceComponents | None = None
    """Variance components that all candidates use, estimated with the one of least BIC (`estimate_weights`)."""


def model_choice(
    block: Block,
    models: Iterable[str | Candidate],
    *,
    k: int = FOLDS,
    seed: int = 0,
    report: Callable[[str], object] = lambda text: None,
) -> ModelChoice:
    """Compare candidates (`candidate_of`) for all cameras of `block`; `k` = 0 omits cross-validation.

    c, x_p and y_p keep their priors (`with_candidate`); the coefficients of a candidate are free. `problem` is the
    reason if a candidate cannot be adjusted. `report` receives progress. Standard deviations that the residuals of the
    candidate with the least BIC contradict are estimated (`estimate_weights`), for all candidates.

    Raises InputError for unknown or repeated candidates or fewer than two folds, BlockError if no image point can be
    omitted.
    """
    candidates = [c if isinstance(c, Candidate) else candidate_of(c) for c in models]
    names = [c.name for c in candidates]
    if not candidates or len(set(names)) < len(names):
        raise InputError(f"name one or more models, each once; got {', '.join(names) or 'none'}")
    if k == 1 or k < 0:
        raise InputError(f"{k} folds: give 2 or more, or 0 for no cross-validation")
    fold = folds(block, k, seed) if k else np.full(len(block.image_points.image), -1)
    _, sizes = fold_blocks(block, fold)
    count = lambda n: report(f"comparing {len(names)} models: adjustment {n} of {len(names) * (k + 2)}")  # noqa: E731
    judged, squares, best = _evaluated(block, candidates, np.full(len(fold), -1), sizes, None, count)
    weights = estimate_weights(best, report=report) if best is not None else None
    if weights:
        block = block.with_observations(weights.adjusted.block.named_observations)
    if best is not None and (weights or k):
        more = lambda n: count(len(names) + n)  # noqa: E731
        judged, squares, _ = _evaluated(block, candidates, fold, sizes, best.unknowns, more)
    return _compared(judged, squares, int((fold >= 0).sum()))._replace(weights=weights)


def _evaluated(
    block: Block,
    candidates: list[Candidate],
    fold: Int[np.ndarray, "rows"],
    sizes: PaddedSizes,
    unknowns: Unknowns | None,
    count: Callable[[int], object],
) -> tuple[list[Judged], list[np.ndarray | None], Adjustment | None]:
    """Adjust with each candidate; return results, squared prediction errors, and the adjustment with the least BIC.

    Orientations and points start at `unknowns`, or at those of the first candidate that converges.
    """
    judged, squares, best = list[Judged](), list[np.ndarray | None](), None
    for number, candidate in enumerate(candidates):
        first = 1 + number * (fold.max() + 2)
        count(first)
        posed = with_candidate(block, candidate, unknowns)
        result, predicted = Judged(candidate), None
        try:
            adjusted = adjust(posed, None if unknowns is None else posed.start.unknowns, sizes=sizes)
            result = _judge(candidate, adjusted)
            if bool(adjusted.converged):
                unknowns = adjusted.unknowns if unknowns is None else unknowns
                if result.bic < min((j.bic for j in judged if np.isfinite(j.bic)), default=np.inf):
                    best = adjusted
                if (fold >= 0).any():
                    after = lambda n, first=first: count(first + n)  # noqa: E731
                    predicted = _predicted(posed, adjusted, fold, sizes, after)
        except (BlockError, DatumError, RankError) as error:
            result = Judged(candidate, str(error))
        judged.append(result)
        squares.append(predicted)
    return judged, squares, best


def _judge(candidate: Candidate, adjusted: Adjustment) -> Judged:
    if not bool(adjusted.converged):
        return Judged(candidate, adjusted.outcome.value)
    block = adjusted.block
    apart, s = measured_discrepancies(block, adjusted.unknowns), float(adjusted.sum_of_squares)
    p, r = adjusted.n_unknowns["interior"], adjusted.redundancy
    n = r + p
    fit = n * np.log(s / n) if r > 0 else _NAN
    aic = fit + 2 * (p + 1)
    return Judged(
        candidate=candidate, n_parameters=p, n_effective=n, redundancy=r, sum_of_squares=s,
        rms_px=float(np.sqrt(np.mean(_squares_px(block, apart)))), aic=aic,
        aicc=aic + 2 * (p + 1) * (p + 2) / (n - p - 2) if n > p + 2 else _NAN, bic=fit + (p + 1) * np.log(n),
        parameters=tuple(significance(adjusted, covariance(adjusted))),
    )  # fmt: skip


def _squares_px(block: Block, apart_mm: Float[np.ndarray, "rows 2"]) -> Float[np.ndarray, "rows"]:
    """Return squared lengths of image discrepancies in pixels."""
    pixel = np.array([block.sensors[camera].pixel_mm for camera in block.image_camera])[block.image_points.image]
    return (apart_mm**2).sum(1) / pixel**2


def _predicted(
    block: Block, adjusted: Adjustment, fold: np.ndarray, sizes: PaddedSizes, counted: Callable[[int], object]
) -> Float[np.ndarray, "left_out"] | None:
    """Return squared prediction errors (px) of all rows that are ever omitted; None if a fold does not converge."""
    squares = np.full(len(fold), _NAN)
    parts, _ = fold_blocks(block, fold)
    for number, part in enumerate(parts):
        counted(number + 1)
        without = adjust(part, adjusted.unknowns, sizes=sizes)
        if not bool(without.converged):
            return None
        omitted = fold == number
        squares[omitted] = _squares_px(block, measured_discrepancies(block, without.unknowns))[omitted]
    return squares[fold >= 0]


def _compared(judged: list[Judged], squares: list[np.ndarray | None], n_left_out: int) -> ModelChoice:
    """Add the results that need all candidates: excess over the smallest prediction error, F tests, and the choice."""
    means = [float(v.mean()) if v is not None else np.inf for v in squares]
    best = squares[int(np.argmin(means))]
    done = []
    for one, own_squares, mean in zip(judged, squares, means, strict=True):
        excess = _NAN
        if own_squares is not None and best is not None:
            apart = own_squares - best
            error = apart.std(ddof=1) / np.sqrt(len(apart))
            excess = float(apart.mean() / error) if error > 0 else 0.0
        smaller = [j for j in judged if not j.problem and not one.problem and j.candidate.within(one.candidate)]
        tested = max(smaller, key=lambda j: j.n_parameters, default=None)
        f, p = _f_test(tested, one) if tested is not None else (_NAN, _NAN)
        name = tested.candidate.name if tested is not None else ""
        rms = float(np.sqrt(mean)) if own_squares is not None else _NAN
        done.append(one._replace(cv_rms_px=rms, cv_excess=excess, smaller=name, f=f, f_p=p))
    converged = [j for j in done if np.isfinite(j.bic)]
    predicting = [j for j in done if j.cv_excess <= 1]
    by_bic = min(converged, key=lambda j: j.bic).candidate.name if converged else ""
    by_cv = min(predicting, key=lambda j: (j.n_parameters, j.cv_rms_px)).candidate.name if predicting else ""
    return ModelChoice(tuple(done), n_left_out, by_bic, by_cv)


def _f_test(smaller: Judged, larger: Judged) -> tuple[float, float]:
    """Return F of the additional coefficients of `larger`, and its p-value under the hypothesis that all are 0."""
    more = larger.n_parameters - smaller.n_parameters
    if larger.redundancy <= 0 or more <= 0:
        return _NAN, _NAN
    f = (smaller.sum_of_squares - larger.sum_of_squares) / more / (larger.sum_of_squares / larger.redundancy)
    return f, float(scipy.special.fdtrc(more, larger.redundancy, max(f, 0.0)))
