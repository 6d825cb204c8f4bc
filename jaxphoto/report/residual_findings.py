"""What the residuals say, as findings: sigma naught, observations that contradict the others, patterns; and what no
test of them could say.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.model.numbers import IMAGE_POINTS
from jaxphoto.block import Block
from jaxphoto.camera import get_parameter, parameter_names
from jaxphoto.errors import camera_words, counted
from jaxphoto.observations import PRIORS
from jaxphoto.procedures.adjust import ABSURD
from jaxphoto.report.findings import Finding, Level, p_words, parameter_words, symbol
from jaxphoto.report.residual_table import in_file_unit
from jaxphoto.report.tables import Tables
from jaxphoto.statistics import (
    DELTA0,
    LEVEL,
    MAX_GROUPS,
    SIGNIFICANT_RATIO,
    EffectTerm,
    Suspect,
    SystematicEffect,
    TermEstimate,
    expected_residual_scale,
    global_test,
    group_factors,
    largest_interior_effects,
    largest_mdbs,
    multiple_outlier_test,
)
from jaxphoto.unknowns import Weighted

ANOTHER_UNIT = 0.1
"""A sigma naught below this says that standard deviations were given in another unit."""
NOTHING_FITS = 3.0
"""A rejected sigma naught above this is no question of weights: something is wrong."""
_SHOWN = 3
_NOT_DISTORTION = ("c_mm", "xp_mm", "yp_mm")
# A suspect is no reservation but an alarm beyond this times the critical value, or where it moves an interior parameter
# by more than `_SPOILT` of its standard deviations; below `_TOLD` that is not worth telling.
_FAR_OUT, _SPOILT, _TOLD = 1.25, 0.5, 0.05
# What is expected of sigma naught may be off from 1 by this; beyond, it is said.
_STRETCHED = 0.01
# A pattern matters where it is more than this of the observations' standard deviation, or moves an interior parameter
# by more than `_MOVED` of its own; smaller ones are found in many observations, and change nothing.
_VISIBLE, _MOVED = 0.25, 1.0
# A pattern is an alarm where its term moves an interior parameter by more than this: by what standard deviations are
# taken for, results are then wrong beyond doubt.
_SPOILT_BY_A_PATTERN = 10.0
# A camera that has changed looks much like stations that are off alike; where either explains about as much (logarithms
# of p-values within a tenth), what is known of the camera is doubted first: it is older.
_AS_GOOD = 1.1
# Of a pattern's square sum, what one term must explain to be named.
MOST_OF_IT = 0.5
# An observation whose detectable error is more than this times its sigma is checked by hardly anything (r < 0.17).
_HIDDEN = 10.0


def of_residuals(tables: Tables) -> Iterator[Finding]:
    """Whether they fit their standard deviations, which of them do not, and whether they follow a pattern."""
    yield from _global_test(tables)
    fits = global_test(tables.adjusted, tables.redundancy).sigma <= ABSURD
    patterns, some = list(_trends(tables, fits)), tables.blunders.suspects
    # What one term explains, and more certainly than any blunder, is the likelier culprit: it makes blunders of many.
    # Where the place is wrong, what is computed to first order there does not tell the two apart.
    first = [p for p in patterns if p.chance < _chance_of_the_worst(tables)] if some and fits else []
    worst = max((f.level for f in _blunders(tables, tables.culprits)), default=Level.INFORMATION) if first else 0
    yield from (p.finding._replace(level=Level(max(p.finding.level, worst))) for p in first)
    beside = [pair for p in first[:1] for pair in p.terms]
    yield from _blunders(
        tables, multiple_outlier_test(tables.adjusted, tables.blunders, beside) if beside else tables.culprits
    )
    yield from (p.finding for p in patterns if all(p is not one for one in first))


def contradictions(tables: Tables) -> Iterator[Finding]:
    """Whether residuals fit their standard deviations, and which do not."""
    yield from _global_test(tables)
    yield from _blunders(tables, tables.culprits)


def _of_such_lenses(block: Block) -> bool:
    """Whether what is known is how far lenses of a kind lie apart: wide for a good one, and of no photographs."""
    # Which observes every distortion as none; who has measured one has found some.
    known = [
        float(prior.value)
        for priors in block.priors.interior.values()
        for name in parameter_names(priors)
        if name not in _NOT_DISTORTION and isinstance(prior := get_parameter(priors, name), Weighted)
    ]
    return bool(known) and not any(known)


def _global_test(tables: Tables) -> Iterator[Finding]:
    """Sigma naught against 1, and which groups of observations it comes from."""
    whole = global_test(tables.adjusted, tables.redundancy)
    if whole.redundancy <= 0:
        yield Finding(
            Level.WARNING,
            "the redundancy is 0: nothing checks anything, and standard deviations rest on those that were given; "
            "add observations",
        )
        return
    tested = group_factors(tables.adjusted, tables.redundancy)
    factors = [f for f in tested if f.p_value < LEVEL / len(tested)]
    if whole.p_value >= LEVEL:
        # Of few observations beside many, sigma naught shows nothing.
        for f in factors:
            if f.group.startswith(PRIORS):
                if f.sigma < 1 and not (f.group == PRIORS and _of_such_lenses(tables.adjusted.block)):
                    yield Finding(
                        Level.WARNING,
                        "what was known of parameters beforehand agrees with this block better than chance allows "
                        f"({p_words(f.p_value)}): if it comes of the same photographs, they count twice and standard "
                        "deviations are too small; leave it out",
                    )
                continue
            size = f"{1 / f.sigma:.2g} times as large as" if f.sigma < 1 else f"{f.sigma:.2g} times smaller than"
            yield Finding(
                Level.WARNING,
                f"the standard deviations of {f.group.replace('_', ' ')} are {size} their residuals say "
                f"({p_words(f.p_value)}), while all observations together fit: correct them (--weights estimates them)",
            )
        return
    groups = ", ".join(f"{f.group.replace('_', ' ')} {f.sigma:.3g}" for f in factors)
    of_groups = f"; by group of observations: {groups}" if groups else ""
    said = f"sigma naught {whole.factor**0.5:.3g}, expected {whole.expected**0.5:.3g} ({p_words(whole.p_value)})"
    if whole.sigma < 1:
        # With one group alone, too large a sigma is made good by the variance factor; with several, weights are wrong.
        unit = whole.sigma < ANOTHER_UNIT and sum(n > 0 for n in tables.adjusted.n_observations.values()) > 1
        yield Finding(
            Level.ALARM if unit else Level.WARNING,
            f"{said}: residuals are smaller than the standard deviations that were given{of_groups}; those are too "
            "large, and where they are not all so by the same factor, the weights are wrong: correct them"
            + ("; so much is no guess but another unit (micrometres or pixels for millimetres)" if unit else ""),
        )
    elif whole.sigma <= NOTHING_FITS:
        yield Finding(
            Level.WARNING,
            f"{said}: residuals are larger than the standard deviations that were given{of_groups}; these are "
            "too small, or there are blunders, or the camera model lacks something",
        )
    else:
        yield Finding(
            Level.ALARM,
            f"{said}: the observations contradict one another or the model{of_groups}; look at approximate values, "
            "units, point ids and the largest residuals, and at what jaxphoto adjust --snoop leaves out",
        )


def of_stretched_residuals(adjusted: Adjustment) -> Iterator[Finding]:
    """Which sigma naught is expected of corrected image coordinates, where it is not 1."""
    for camera, factor in expected_residual_scale(adjusted).items() if adjusted.redundancy > 0 else ():
        if abs(factor - 1) > _STRETCHED:
            yield Finding(
                Level.INFORMATION,
                f"{camera_words(camera)}: residuals are of corrected image coordinates, which its distortion "
                f"{'stretches' if factor > 1 else 'shrinks'}; sigma naught of its image points is expected to be "
                f'{factor:.3g}, not 1: say residuals = "measured" in [cameras.{camera}]',
            )


def _blunders(tables: Tables, accused: Sequence[Suspect]) -> Iterator[Finding]:
    """The likeliest culprit first, and no suspect that worse ones (or a pattern that stands before them) explain.

    An alarm where it is far beyond the critical value or moves the interior orientation; else a reservation: of many
    thousand real observations some are a little too far out.
    """
    limit = tables.blunders.limit
    effects = [(s, *_effect(tables, s)) for s in accused]
    judged = [(abs(s.w) > _FAR_OUT * limit or moved > _SPOILT, s, what, moved) for s, what, moved in effects]
    for alarming, s, what, moved in sorted(judged, key=lambda j: not j[0])[:_SHOWN]:
        factor, unit = in_file_unit(s.unit)
        told = f"; that moves {what} by {moved:.1g} of its sigma" if moved > _TOLD else ""
        yield Finding(
            Level.ALARM if alarming else Level.WARNING,
            f"{s.words} contradicts the other observations: if it alone is wrong, by {factor * s.error:+.3g} +- "
            f"{factor * s.sigma:.2g} {unit} (w {s.w:.1f}, critical {limit:.1f}){told}",
        )
    if beside := len(tables.blunders.suspects) - len(judged):
        yield Finding(
            Level.INFORMATION,
            f"{counted(beside, 'more observation')} {'is' if beside == 1 else 'are'} beyond the critical value, too, "
            "but not once what stands before is mended",
        )
    if len(judged) > _SHOWN:
        yield Finding(
            Level.ALARM if any(alarming for alarming, *_ in judged) else Level.WARNING,
            f"{len(judged)} of {tables.blunders.n} observations are beyond the critical value, each although the "
            "worse ones are out: jaxphoto adjust --snoop leaves out what must go",
        )


def _effect(tables: Tables, suspect: Suspect) -> tuple[str, float]:
    """The interior parameter that moves most with the error of a suspect, in a posteriori standard deviations."""
    moved = {
        parameter: np.atleast_2d(of[suspect.group])[suspect.number, suspect.row] * abs(suspect.w) / DELTA0
        for parameter, of in tables.undetected.interior.items()
    }
    known = {parameter: float(v) for parameter, v in moved.items() if np.isfinite(v)}
    return max(known.items(), key=lambda item: item[1], default=("", 0.0))


def _chance_of_the_worst(tables: Tables) -> float:
    """Of a normalised residual among all that there are."""
    w = max(abs(s.w) for s in tables.blunders.suspects)
    return tables.blunders.n * float(scipy.special.erfc(w / np.sqrt(2)))


class _Pattern(NamedTuple):
    """A pattern that is beyond chance."""

    chance: float
    """Its p-value: 1 where no usual term explains it, or it does not matter, and 0 where it explains most of what looks
    like blunders."""
    finding: Finding
    terms: tuple[tuple[SystematicEffect, EffectTerm], ...]
    """That are most of it."""


def _trends(tables: Tables, fits: bool) -> Iterator[_Pattern]:
    """Patterns that are beyond chance, the most certain first. Where nothing `fits`, cameras are not looked at."""
    level = LEVEL / max(len(tables.tested_trends), 1)
    # Of images that do not fit at all, the pattern is what the misfit makes of them, and no term of the camera.
    told = (t for t in tables.tested_trends if t.p_value < level and (fits or not t.pattern.camera))
    for t in sorted(told, key=lambda t: t.p_value ** (_AS_GOOD if t.pattern.begins else 1.0)):
        factor, unit = in_file_unit(t.pattern.unit)
        said = t.pattern.begins or f"residuals of {t.pattern.what} follow a pattern"
        said += f" ({p_words(t.p_value)})"
        if t.size > 0 and unit:
            said += f" of {factor * t.size:.2g} {unit} ({t.size / t.sigma:.2g} of their sigma)"
        matters, spoilt, likely = t.size > _VISIBLE * t.sigma, False, list[TermEstimate]()
        alike = t.significant_terms
        # What estimated parameters nearly take up is seen so badly that its size is lost in its noise.
        matters |= any(abs(h.amount) > _VISIBLE * t.sigma for h in alike)
        if alike or (t.hints and t.hints[0].share > MOST_OF_IT):
            likely = alike or [t.hints[0]]
            share = "" if alike else f"{100 * t.hints[0].share:.0f} % of it "
            said += f", {share}{_told(t.pattern, likely)}"
            moves = {path: abs(sum(h.moves[path] for h in likely)) for path in likely[0].moves}
            path = max(moves, key=lambda path: moves[path], default="")
            if path and (moved := moves[path]) > _MOVED:
                matters, spoilt = True, moved > _SPOILT_BY_A_PATTERN
                said += f"; {parameter_words(path)} would move by {moved:.1f} of its sigma"
        elif t.pattern.camera:
            said += ": no single usual term is most of it; try a distortion of more terms (docs/model_choice.md)"
        elif several := [h for h in t.hints if abs(h.amount) > SIGNIFICANT_RATIO * h.sigma][:_SHOWN]:
            said += f", each alone {_told(t.pattern, several)}"
        level = Level.ALARM if spoilt else Level.WARNING if matters else Level.INFORMATION
        # Blunders that the term would make are none: beside them, what is left of its rows says the same.
        most = t.matching_blunders >= _SHOWN and t.matching_blunders > len(tables.blunders.suspects) / 2
        chance = 0.0 if most else t.p_value
        terms = tuple((t.pattern, h.term) for h in likely)
        yield _Pattern(chance if matters and likely else 1.0, Finding(level, said), terms)


def _hidden_in_common(tables: Tables) -> Iterator[Finding]:
    """Of errors that all rows of a group have in common, how large they may be unseen, and what they then do."""
    for t in (t for t in tables.tested_trends if t.pattern.group):
        worst: tuple[float, str, TermEstimate] | None = None
        for h in (h for h in t.hints if h.amount != 0.0):
            for path, moved in h.moves.items():
                # Of an error that is found with a probability of 80 %.
                size = abs(moved / h.amount) * DELTA0 * h.sigma
                worst = max(worst or (0.0, "", h), (size, path, h), key=lambda w: w[0])
        if worst is not None and worst[0] > _MOVED:
            size, path, h = worst
            factor, unit = in_file_unit(t.pattern.unit)
            least = f"{factor * DELTA0 * h.sigma:.2g} {unit}"
            yield Finding(
                Level.INFORMATION,
                f"{t.pattern.what}: an error in {h.term.name} that they have in common would be found with a "
                f"probability of 80 % from {least} on, and one of that size moves {parameter_words(path)} by "
                f"{size:.2g} of its sigma",
            )


def _told(pattern: SystematicEffect, likely: list[TermEstimate]) -> str:
    """The likeliest terms, their amounts where these are in the observations' own unit, and what cures them."""
    factor, unit = in_file_unit(pattern.unit)
    amounts = (f" {factor * h.amount:+.3g} +- {factor * h.sigma:.2g} {unit}".rstrip() for h in likely)
    names = ", ".join(h.term.name + (a if h.term.report_amount else "") for h, a in zip(likely, amounts, strict=True))
    cure = likely[0].term.cure
    return f"{names}, {cure}" if cure else names


def of_what_is_not_checked(tables: Tables) -> Iterator[Finding]:
    """What no test could find: points of two rays, and how large an error of each further group may stay hidden."""
    adjusted = tables.adjusted
    if (n := len(adjusted.block.sensors)) > MAX_GROUPS:
        yield Finding(
            Level.INFORMATION,
            f"of {n} cameras neither patterns over their formats nor what undetected errors do to each are looked at; "
            f"of up to {MAX_GROUPS} they are",
        )
    rays = np.bincount(adjusted.structure.point, minlength=len(adjusted.block.points))
    if twice := int((rays == 2).sum()):
        yield Finding(
            Level.INFORMATION,
            f"{twice} of {len(rays)} points are in two images only: an error along the plane of their rays shows "
            "nowhere",
        )
    if felt := [f for f in largest_interior_effects(adjusted, tables.undetected) if f.moved > _MOVED]:
        told = ", ".join(f"{symbol(f.parameter)} by up to {f.moved:.1f} of its sigma ({f.words})" for f in felt)
        yield Finding(Level.INFORMATION, f"an error that no test finds (power 80 %) would move {told}")
    yield from _hidden_in_common(tables)
    for hidden in largest_mdbs(adjusted, tables.redundancy):
        if hidden.group != IMAGE_POINTS and hidden.mdb > _HIDDEN * hidden.sigma:
            factor, unit = in_file_unit(hidden.unit)
            told = (
                f"an error of {factor * hidden.mdb:.2g} {unit} would be found with a probability of 80 % only, "
                "a smaller one less often"
                if np.isfinite(hidden.mdb)
                else "nothing checks it, and no error of it would be found, however large"
            )
            text = f"{hidden.words}: {told} (its sigma is {factor * hidden.sigma:.2g} {unit})"
            yield Finding(Level.INFORMATION, text)
