"""Which distortion model does one block need: cross-validation, information criteria and significance of several.

Every candidate is adjusted to all observations, and to the block without each of k folds (`cross_validation`); each by
the same residuals, those of *measured* image coordinates. Orientations and points are estimated anew with
every candidate and grow with the block: they are not what is chosen. What is left for the camera are

    N = observations + constraints - unknowns other than interior ones = redundancy + p

numbers, of which a candidate with p interior unknowns and the common variance factor explains all but S = v'Pv:

    AIC = N ln(S / N) + 2 (p + 1),    AICc = AIC + 2 (p + 1)(p + 2) / (N - p - 2),    BIC = N ln(S / N) + (p + 1) ln N
    F   = (S_smaller - S) / (p - p_smaller) / (S / redundancy)    of a candidate and one that it contains

Counting all unknowns instead would put S / n in the place of S / N and favour large models, as n is often twice N.
Source: Burnham and Anderson (2002), Model selection; residual likelihood: Patterson and Thompson (1971).
"""

from collections.abc import Callable, Iterable
from typing import NamedTuple

import numpy as np
import scipy
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment, PaddedSizes
from jaxphoto.block import Block
from jaxphoto.errors import BlockError, DatumError, InputError, RankError
from jaxphoto.procedures.adjust import adjust
from jaxphoto.procedures.camera_candidates import Candidate, candidate_of, with_candidate
from jaxphoto.procedures.cross_validation import fold_blocks, folds, measured_discrepancies
from jaxphoto.statistics import Significance, covariance, significance
from jaxphoto.unknowns import Unknowns

FOLDS = 5
_NAN = float("nan")


class Judged(NamedTuple):
    """What one candidate is worth; numbers are NaN where it could not be adjusted, and `problem` says why.

    `rms_px` and `cv_rms_px` are root mean squares of the length of the image discrepancy (both axes together) of
    adjusted and of left-out image points. `cv_excess` is by how many standard errors the mean square of the latter is
    above that of the candidate that predicts best, from the differences image point by image point.
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
    """The largest candidate that this one contains, against which F tests it."""
    f: float = _NAN
    f_p: float = _NAN
    parameters: tuple[Significance, ...] = ()

    @property
    def sigma0(self) -> float:
        """Of residuals of measured coordinates."""
        return float(np.sqrt(self.sum_of_squares / self.redundancy)) if self.redundancy > 0 else _NAN

    @property
    def weakest(self) -> Significance | None:
        """The estimated coefficient of the distortion with the smallest ratio to its standard deviation."""
        own = [s for s in self.parameters if s.parameter in self.candidate.free]
        return min(own, key=lambda s: s.ratio, default=None)


class ModelChoice(NamedTuple):
    """All candidates as judged, in the order given; `by_bic` and `by_prediction` are names, "" where none converged.

    `by_prediction` is the candidate with fewest parameters that predicts left-out points no more than one standard
    error worse than the best.
    """

    judged: tuple[Judged, ...]
    n_left_out: int
    by_bic: str
    by_prediction: str


def model_choice(
    block: Block,
    models: Iterable[str | Candidate],
    *,
    k: int = FOLDS,
    seed: int = 0,
    report: Callable[[str], object] = lambda text: None,
) -> ModelChoice:
    """Compare candidates (`candidate_of`) for all cameras of `block`; `k` = 0 leaves cross-validation out.

    c, x_p and y_p are what the block says of them (`with_candidate`), the coefficients of a candidate are free. What
    cannot be adjusted is judged unfit, with the reason. `report` is told of each adjustment.

    Raises InputError for unknown or repeated candidates or fewer than two folds, BlockError where nothing can be left
    out.
    """
    candidates = [c if isinstance(c, Candidate) else candidate_of(c) for c in models]
    names = [c.name for c in candidates]
    if not candidates or len(set(names)) < len(names):
        raise InputError(f"name at least one model, and each but once; there are {', '.join(names) or 'none'}")
    if k == 1 or k < 0:
        raise InputError(f"{k} folds cannot be; leave out one of at least 2, or 0 for no cross-validation")
    fold = folds(block, k, seed) if k else np.full(len(block.image_points.image), -1)
    _, sizes = fold_blocks(block, fold)
    judged: list[Judged] = []
    squares: list[np.ndarray | None] = []
    known: Unknowns | None = None
    for number, candidate in enumerate(candidates):
        counted = lambda fold, first=1 + number * (k + 1): report(  # noqa: E731
            f"comparing {len(names)} models: adjustment {first + fold} of {len(names) * (k + 1)}"
        )
        counted(0)
        own = with_candidate(block, candidate, known)
        try:
            adjusted = adjust(own, None if known is None else own.start.unknowns, sizes=sizes)
            found = _judge(candidate, adjusted)
            squares.append(_predicted(own, adjusted, fold, sizes, counted) if k else None)
            known = adjusted.unknowns if known is None and bool(adjusted.converged) else known
        except (BlockError, DatumError, RankError) as error:
            found = Judged(candidate, str(error))
            squares.append(None)
        judged.append(found)
    return _compared(judged, squares, int((fold >= 0).sum()))


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
        candidate=candidate,
        n_parameters=p,
        n_effective=n,
        redundancy=r,
        sum_of_squares=s,
        rms_px=float(np.sqrt(np.mean(_squares_px(block, apart)))),
        aic=aic,
        aicc=aic + 2 * (p + 1) * (p + 2) / (n - p - 2) if n > p + 2 else _NAN,
        bic=fit + (p + 1) * np.log(n),
        parameters=tuple(significance(adjusted, covariance(adjusted))),
    )


def _squares_px(block: Block, apart_mm: Float[np.ndarray, "rows 2"]) -> Float[np.ndarray, "rows"]:
    """Squared lengths of image discrepancies in pixels of their cameras."""
    pixel = np.array([block.sensors[camera].pixel_mm for camera in block.image_camera])[block.image_points.image]
    return (apart_mm**2).sum(1) / pixel**2


def _predicted(
    block: Block, adjusted: Adjustment, fold: np.ndarray, sizes: PaddedSizes, counted: Callable[[int], object]
) -> Float[np.ndarray, "left_out"] | None:
    """Squared prediction errors (px) of all rows that are ever left out; None where a fold does not converge."""
    if not bool(adjusted.converged):
        return None
    squares = np.full(len(fold), _NAN)
    parts, _ = fold_blocks(block, fold)
    for number, part in enumerate(parts):
        counted(number + 1)
        without = adjust(part, adjusted.unknowns, sizes=sizes)
        if not bool(without.converged):
            return None
        own = fold == number
        squares[own] = _squares_px(block, measured_discrepancies(block, without.unknowns))[own]
    return squares[fold >= 0]


def _compared(judged: list[Judged], squares: list[np.ndarray | None], n_left_out: int) -> ModelChoice:
    """What needs all candidates: prediction beside the best, F against smaller ones, and the choice."""
    means = [float(v.mean()) if v is not None else np.inf for v in squares]
    best = squares[int(np.argmin(means))]
    done = []
    for one, mine, mean in zip(judged, squares, means, strict=True):
        excess = _NAN
        if mine is not None and best is not None:
            apart = mine - best
            error = apart.std(ddof=1) / np.sqrt(len(apart))
            excess = float(apart.mean() / error) if error > 0 else 0.0
        smaller = [j for j in judged if not j.problem and not one.problem and j.candidate.within(one.candidate)]
        tested = max(smaller, key=lambda j: j.n_parameters, default=None)
        f, p = _f_test(tested, one) if tested is not None else (_NAN, _NAN)
        name = tested.candidate.name if tested is not None else ""
        rms = float(np.sqrt(mean)) if mine is not None else _NAN
        done.append(one._replace(cv_rms_px=rms, cv_excess=excess, smaller=name, f=f, f_p=p))
    sound = [j for j in done if np.isfinite(j.bic)]
    predicting = [j for j in done if j.cv_excess <= 1]
    by_bic = min(sound, key=lambda j: j.bic).candidate.name if sound else ""
    by_cv = min(predicting, key=lambda j: (j.n_parameters, j.cv_rms_px)).candidate.name if predicting else ""
    return ModelChoice(tuple(done), n_left_out, by_bic, by_cv)


def _f_test(smaller: Judged, larger: Judged) -> tuple[float, float]:
    """F of the coefficients that `larger` has more, and how probable so large a one is if they were all 0."""
    more = larger.n_parameters - smaller.n_parameters
    if larger.redundancy <= 0 or more <= 0:
        return _NAN, _NAN
    f = (smaller.sum_of_squares - larger.sum_of_squares) / more / (larger.sum_of_squares / larger.redundancy)
    return f, float(scipy.special.fdtrc(more, larger.redundancy, max(f, 0.0)))
