"""Findings on residuals: sigma naught, blunders, systematic effects; and on reliability, rejections and weights."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import scipy

from jaxphoto import statistics
from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.model.numbers import IMAGE_POINTS
from jaxphoto.block import Block
from jaxphoto.camera import get_parameter, parameter_names
from jaxphoto.errors import camera_words, counted, few
from jaxphoto.observations import PRIORS, Correlated
from jaxphoto.procedures.adjust import ABSURD
from jaxphoto.procedures.snooping import SEVERAL, InflatedComponent, Snooped, mostly_rejected, rejected_images
from jaxphoto.report.findings import SEVERITIES, Finding, Severity, p_words
from jaxphoto.report.formatting import in_file_unit, plus_minus, symbol
from jaxphoto.report.tables import Tables
from jaxphoto.statistics.input_precision import rounded_columns, small_sigmas
from jaxphoto.unknowns import Weighted

ANOTHER_UNIT = 0.1
"""Sigma naught below which standard deviations are assumed to be in a wrong unit."""
NOTHING_FITS = 3.0
"""Sigma naught above which wrong weights are not a sufficient explanation."""
MOST_OF_IT = 0.5
"""Fraction of a systematic effect's sum of squares above which a single term explains it."""
_SHOWN = 3
_Term = tuple[statistics.SystematicEffect, statistics.EffectTerm]
_NOT_DISTORTION = ("c_mm", "xp_mm", "yp_mm")
# Ratio of |w| to the critical value, and shift of an interior parameter (sigma), above which a blunder is an error;
# minimum reported shift (sigma).
_FAR_OUT, _SPOILT, _REPORTED = 1.25, 0.5, 0.05
# Minimum reported deviation of the expected sigma naught from 1.
_STRETCHED = 0.01
# Ratio of a systematic effect to the sigma of its observations, and shift of an interior parameter (sigma), above which
# the effect is a warning; shift above which it is an error.
_VISIBLE, _MOVED, _SPOILT_BY_EFFECT = 0.25, 1.0, 10.0
# Exponent of the p-values of common station biases. A changed camera has a similar effect: if p-values are similar
# (logarithms within a tenth), the prior of the camera is reported first, because it is older.
_SIMILAR = 1.1
# Ratio of MDB to sigma above which an observation is hardly checked (r < 0.17).
_HIDDEN = 10.0


def residual_findings(tables: Tables) -> Iterator[Finding]:
    """Yield the tests of sigma naught, of single residuals and of systematic effects.

    Large errors are estimated as unknowns (`statistics.error_sizes`), and effects that they explain are omitted.
    """
    yield from _global_test(tables)
    fits = statistics.global_test(tables.adjusted, tables.redundancy).sigma <= ABSURD
    effects, suspects = list(_systematic(tables, fits)), tables.blunders.suspects
    # First report effects with smaller p-values than the largest suspect: they appear as blunders in many observations.
    # If sigma naught is far too large, first-order theory cannot separate the two.
    worst_w = max((abs(s.w) for s in suspects), default=0.0)
    by_chance = tables.blunders.n * float(scipy.special.erfc(worst_w / np.sqrt(2)))
    first = [e for e in effects if e.chance < by_chance] if suspects and fits else []
    terms = [pair for effect in first[:1] for pair in effect.terms]
    culprits = statistics.multiple_outlier_test(tables.adjusted, tables.blunders, terms) if terms else tables.culprits
    sizes = _sizes(tables, culprits, terms or [pair for e in effects[:1] if not suspects for pair in e.terms])
    blunders = list(_blunders(tables, culprits, sizes))
    names = [e.subject for e in first]
    if sizes:
        before, effects = effects, list(_systematic(tables, fits, sizes))
        explained = {e.subject for e in before} - {e.subject for e in effects}
        blunders += [Finding("explained_effects", "note", subject) for subject in sorted(explained)]
    worst = min((SEVERITIES.index(f.severity) for f in _blunders(tables, tables.culprits)), default=len(SEVERITIES) - 1)
    for effect in (e for e in effects if e.subject in names):
        severity = SEVERITIES[min(SEVERITIES.index(effect.severity), worst)]
        yield effect.finding(severity)
    yield from blunders
    yield from (e.finding(e.severity) for e in effects if e.subject not in names)


# Ratio of an error to its a priori sigma above which first-order theory does not give its size, and maximum
# number of errors that are estimated together.
_LARGE, _TOGETHER = 10.0, 16


def _sizes(
    tables: Tables, suspects: Sequence[statistics.Suspect], terms: Sequence[_Term]
) -> statistics.ErrorSizes | None:
    """Estimate the errors as unknowns if one of them is large."""
    names = {(effect.what, term.name) for effect, term in terms}
    ratios = [abs(s.w) for s in suspects]
    for t in tables.tested_trends:
        ratios += [abs(h.amount) / h.sigma for h in t.hints if (t.pattern.what, h.term.name) in names]
    if not _is_large(tables, max(ratios, default=0.0)) or len(suspects) > _TOGETHER:
        return None
    return statistics.error_sizes(tables.adjusted, suspects, terms)


def _signed(value: float, sigma: float) -> str:
    return f"{'+' * (value > 0)}{plus_minus(value, sigma)}"


def _is_large(tables: Tables, ratio: float) -> bool:
    """Return True if first-order theory does not give an error of `ratio` a posteriori standard deviations."""
    return ratio * float(tables.adjusted.sigma0) > _LARGE


def input_findings(tables: Tables, residual: Sequence[Finding]) -> Iterator[Finding]:
    """Yield columns of rounded values and standard deviations that no instrument reaches.

    Rounding whose errors exceed the standard deviation is a warning; it is as severe as the worst of the `residual`
    findings, which it may cause, if the residuals of its column are too large.
    """
    worst = min((SEVERITIES.index(f.severity) for f in residual), default=len(SEVERITIES) - 1)
    for c in rounded_columns(tables.adjusted, tables.redundancy):
        severity: Severity = "warning" if c.exceeded or c.error > c.sigma else "note"
        if c.exceeded:
            severity = SEVERITIES[min(worst, SEVERITIES.index(severity))]
        numbers = {"n": c.n, "unit": c.unit, "error": c.error}
        numbers["cause"] = " and may cause the findings below" if c.exceeded and residual else ""
        hint = "Its sigma must include that error" if severity == "note" else ""
        yield Finding("rounded", severity, f"{c.table}, column {c.column}", c.step, c.sigma, hint, numbers)
    for s in small_sigmas(tables.adjusted):
        subject = f"{s.table}, sigma of {', '.join(s.axes)}" if s.axes else f"{s.table}, sigma"
        numbers = {"n": s.n, "total": s.total, "unit": s.unit}
        yield Finding("small_sigma", "warning", subject, s.sigma, s.limit, numbers=numbers)


def contradictions(tables: Tables) -> Iterator[Finding]:
    """Yield the tests of sigma naught and of single residuals."""
    yield from _global_test(tables)
    yield from _blunders(tables, tables.culprits)


def _priors_of_lens_type(block: Block) -> bool:
    """Return True if the priors describe the spread of a lens type, whose mean distortion is zero."""
    values = [
        float(prior.value)
        for priors in block.priors.interior.values()
        for name in parameter_names(priors)
        if name not in _NOT_DISTORTION and isinstance(prior := get_parameter(priors, name), Weighted)
    ]
    return bool(values) and not any(values)


def _global_test(tables: Tables) -> Iterator[Finding]:
    """Compare sigma naught with its expectation, and find the groups of observations that cause a deviation."""
    whole = statistics.global_test(tables.adjusted, tables.redundancy)
    if whole.redundancy <= 0:
        yield Finding("no_redundancy", "warning")
        return
    tested = statistics.group_factors(tables.adjusted, tables.redundancy)
    factors = [f for f in tested if f.p_value < statistics.LEVEL / len(tested)]
    if whole.p_value >= statistics.LEVEL:
        # Test the groups separately: a few observations among many do not affect sigma naught.
        for f in factors:
            p = {"p": p_words(f.p_value)}
            if not f.group.startswith(PRIORS):
                factor, size = (1 / f.sigma, "large") if f.sigma < 1 else (f.sigma, "small")
                numbers = p | {"factor": factor, "size": size}
                yield Finding("group_sigma", "warning", f.group.replace("_", " "), f.sigma, 1.0, numbers=numbers)
            elif f.sigma < 1 and not (f.group == PRIORS and _priors_of_lens_type(tables.adjusted.block)):
                yield Finding("prior_counted_twice", "warning", value=f.sigma, limit=1.0, numbers=p)
        return
    groups = ", ".join(f"{f.group.replace('_', ' ')} {f.sigma:.3g}" for f in factors)
    numbers = {"p": p_words(whole.p_value), "groups": f"; by group: {groups}" if groups else ""}
    severity: Severity = "warning"
    if whole.sigma < 1:
        # With a single group the variance factor absorbs a wrong sigma; with several, the relative weights are wrong.
        several = sum(n > 0 for n in tables.adjusted.n_observations.values()) > 1
        unit = whole.sigma < ANOTHER_UNIT and several
        code, severity = ("sigma0_unit", "error") if unit else ("sigma0_small", "warning")
    elif whole.sigma <= NOTHING_FITS:
        code = "sigma0_large"
    else:
        code, severity = "sigma0_contradiction", "error"
    yield Finding(code, severity, value=whole.factor**0.5, limit=whole.expected**0.5, numbers=numbers)


def stretch_findings(adjusted: Adjustment) -> Iterator[Finding]:
    """Yield cameras whose distortion scales residuals, so that the expected sigma naught differs from 1."""
    for camera, factor in statistics.expected_residual_scale(adjusted).items() if adjusted.redundancy > 0 else ():
        if abs(factor - 1) > _STRETCHED:
            hint = f'Remove residuals = "model" from [cameras.{camera}]'
            yield Finding("stretched", "note", camera_words(camera), factor, 1.0, hint)


def _blunders(
    tables: Tables, suspects: Sequence[statistics.Suspect], sizes: statistics.ErrorSizes | None = None
) -> Iterator[Finding]:
    """Yield the most likely blunders, with their `sizes` if estimated as unknowns.

    A blunder is an error if it is far above the critical value or shifts the interior orientation. Otherwise it is a
    warning: among thousands of valid observations a few slightly exceed the limit.
    """
    limit = tables.blunders.limit
    effects = [(s, *_effect(tables, s)) for s in suspects]
    judged = [(abs(s.w) > _FAR_OUT * limit or moved > _SPOILT, s, name, moved) for s, name, moved in effects]
    for severe, s, name, moved in sorted(judged, key=lambda j: not j[0])[:_SHOWN]:
        factor, unit = in_file_unit(s.unit)
        error, sigma = sizes.suspects[s.group, s.row, s.number] if sizes else (s.error, s.sigma)
        # Labels of image points contain no coordinate.
        unit += f" in {'xy'[s.number]}" if s.group == IMAGE_POINTS else ""
        size = f"{_signed(factor * error, factor * sigma)} {unit} if it alone is wrong"
        if sizes:
            others = len(sizes.suspects) + len(sizes.terms) - 1
            size = size.replace("it alone is", f"it and {counted(others, 'other error')} are") if others else size
        elif _is_large(tables, abs(s.w)):
            size = f"about {factor * error:+.2g} {unit} (its standard deviation is not known)"
        numbers = {
            "size": size, "w": s.w,
            "effect": f"; it moves {symbol(name)} by {moved:.1g} sigma" if moved > _REPORTED else "",
        }  # fmt: skip
        severity: Severity = "error" if severe else "warning"
        yield Finding("blunder", severity, s.words, factor * error, limit, numbers=numbers)
    if explained := len(tables.blunders.suspects) - len(judged):
        yield Finding("explained_suspects", "note", value=explained, limit=limit)
    if len(judged) > _SHOWN:
        severity = "error" if any(severe for severe, *_ in judged) else "warning"
        numbers = {"n": tables.blunders.n}
        yield Finding("many_blunders", severity, value=len(judged), limit=limit, numbers=numbers)


def _effect(tables: Tables, suspect: statistics.Suspect) -> tuple[str, float]:
    """Return the interior parameter that the error of a suspect shifts most, and the shift in a posteriori sigmas."""
    moved = {
        parameter: float(np.atleast_2d(of[suspect.group])[suspect.number, suspect.row])
        * abs(suspect.w)
        / statistics.DELTA0
        for parameter, of in tables.undetected.interior.items()
    }
    return max(((p, v) for p, v in moved.items() if np.isfinite(v)), key=lambda item: item[1], default=("", 0.0))


class _Effect(NamedTuple):
    """A significant systematic effect."""

    chance: float
    """p-value; 1 if no usual term explains the effect or it is negligible, 0 if it explains most of the suspects."""
    severity: Severity
    subject: str
    value: float
    limit: float
    numbers: dict[str, Any]
    terms: tuple[_Term, ...]
    """Terms that explain most of the effect."""
    explained: float
    """Reduction of v'Pv by the effect, with `freedom` unknowns."""
    freedom: int

    def finding(self, severity: Severity) -> Finding:
        """Return the effect as a finding."""
        return Finding("systematic", severity, self.subject, self.value, self.limit, numbers=self.numbers)


def _systematic(tables: Tables, fits: bool, sizes: statistics.ErrorSizes | None = None) -> Iterator[_Effect]:
    """Yield significant systematic effects by increasing p-value; effects of cameras only if `fits`.

    With the `sizes` of errors estimated as unknowns, effects that these explain are omitted.
    """
    level = statistics.LEVEL / max(len(tables.tested_trends), 1)
    tests = _with_sizes(tables, sizes, level) if sizes else tables.tested_trends
    found = (t for t in tests if t.p_value < level and (fits or not t.pattern.camera))
    # If p-values underflow, the effect that explains most is first.
    for t in sorted(found, key=lambda t: (t.p_value ** (_SIMILAR if t.pattern.begins else 1.0), -t.explained)):
        factor, unit = in_file_unit(t.pattern.unit)
        detail, likely, spoilt = "", list[statistics.TermEstimate](), False
        if t.size > 0 and unit:
            detail = f", size {factor * t.size:.2g} {unit} ({t.size / t.sigma:.2g} sigma)"
        together = t.significant_terms
        # Test both the size and the estimated terms: estimated parameters absorb part of an effect, whose size may then
        # be below the noise.
        matters = t.size > _VISIBLE * t.sigma or any(abs(h.amount) > _VISIBLE * t.sigma for h in together)
        if together or (t.hints and t.hints[0].share > MOST_OF_IT):
            likely = together or [t.hints[0]]
            fraction = "" if together else f"{100 * t.hints[0].share:.0f} % of it "
            known = sizes is not None and any(what == t.pattern.what for what, _ in sizes.terms)
            detail += f", {fraction}{_terms(tables, t.pattern, likely, known)}"
            moves = {path: abs(sum(h.moves[path] for h in likely)) for path in likely[0].moves}
            path = max(moves, key=lambda path: moves[path], default="")
            if path and (moved := moves[path]) > _MOVED:
                matters, spoilt = True, moved > _SPOILT_BY_EFFECT
                detail += f"; {path} would move by {moved:.1f} sigma"
        elif t.pattern.camera:
            detail += ": no single common term explains most of it; try a model with more terms (docs/stability.md)"
        elif several := [h for h in t.hints if abs(h.amount) > statistics.SIGNIFICANT_RATIO * h.sigma][:_SHOWN]:
            detail += f", each alone {_terms(tables, t.pattern, several)}"
        # Count the suspects explained by the terms: these are not blunders.
        most = t.matching_blunders >= _SHOWN and t.matching_blunders > len(tables.blunders.suspects) / 2
        chance = (0.0 if most else t.p_value) if matters and likely else 1.0
        subject = t.pattern.begins or f"systematic residuals of {t.pattern.what}"
        numbers = {"p": p_words(t.p_value), "detail": detail}
        severity: Severity = "error" if spoilt else "warning" if matters else "note"
        terms = tuple((t.pattern, h.term) for h in likely)
        limit = _VISIBLE * factor * t.sigma
        yield _Effect(chance, severity, subject, factor * t.size, limit, numbers, terms, t.explained, t.freedom)


def _terms(
    tables: Tables, pattern: statistics.SystematicEffect, likely: list[statistics.TermEstimate], known: bool = False
) -> str:
    """Describe the likely terms with their estimates, and the cure. `known`: estimated as unknowns."""
    factor, unit = in_file_unit(pattern.unit)

    def amount(h: statistics.TermEstimate) -> str:
        if known or not _is_large(tables, abs(h.amount) / h.sigma):
            return f" {_signed(factor * h.amount, factor * h.sigma)} {unit}".rstrip()
        return f" about {factor * h.amount:+.2g} {unit}".rstrip()

    names = ", ".join(h.term.name + (amount(h) if h.term.report_amount else "") for h in likely)
    cure = likely[0].term.cure
    return f"{names}, {cure}" if cure else names


def _with_sizes(tables: Tables, sizes: statistics.ErrorSizes, level: float) -> list[statistics.EffectTest]:
    """Return the tests with the estimated sizes, without effects that are not significant after correction."""
    shared = np.asarray(statistics.covariance(sizes.adjusted).shared_sigma)
    left = statistics.systematic_effect_tests(sizes.adjusted, shared)
    remaining = {t.pattern.what for t in left if t.p_value < level}
    sigma = dict(zip(sizes.adjusted.structure.labels, shared.tolist(), strict=True))
    moves = {}
    for path in (label for label in sigma if label.startswith("interior[") and sigma[label] > 0):
        camera, name = path.removeprefix("interior[").rsplit("].", 1)
        value, corrected = (
            float(get_parameter(a.unknowns.interior[camera], name)) for a in (tables.adjusted, sizes.adjusted)
        )
        moves[path] = (value - corrected) / sigma[path]
    tests = []
    for t in tables.tested_trends:
        estimates = {name: size for (what, name), size in sizes.terms.items() if what == t.pattern.what}
        if estimates:
            # All terms together move the parameters: the first has the change.
            hints, change = [], moves
            for h in t.hints:
                if h.term.name in estimates:
                    amount, deviation = estimates[h.term.name]
                    h, change = h._replace(amount=amount, sigma=deviation, moves=change), dict.fromkeys(moves, 0.0)
                hints.append(h)
            ratio = abs(hints[0].amount / t.hints[0].amount) if t.hints[0].amount else 1.0
            tests.append(t._replace(hints=tuple(hints), size=t.size * ratio))
        elif t.pattern.what in remaining:
            tests.append(t)
    return tests


# Reliability -----------------------------------------------------------------------------------------------------


def reliability_findings(tables: Tables) -> Iterator[Finding]:
    """Yield points with two rays, external reliability, and observations with large MDBs."""
    adjusted = tables.adjusted
    if (n := len(adjusted.block.sensors)) > statistics.MAX_GROUPS:
        yield Finding("not_tested_by_camera", "note", value=n, limit=statistics.MAX_GROUPS)
    rays = np.bincount(adjusted.structure.point, minlength=len(adjusted.block.points))
    if two := int((rays == 2).sum()):
        yield Finding("two_rays", "note", value=two, numbers={"n": len(rays)})
    if felt := [f for f in statistics.largest_interior_effects(adjusted, tables.undetected) if f.moved > _MOVED]:
        subject = ", ".join(f"{symbol(f.parameter)} by up to {f.moved:.1f} sigma ({f.words})" for f in felt)
        yield Finding("external_reliability", "note", subject, max(f.moved for f in felt), _MOVED)
    yield from _common_biases(tables)
    for hidden in statistics.largest_mdbs(adjusted, tables.redundancy):
        if hidden.group != IMAGE_POINTS and hidden.mdb > _HIDDEN * hidden.sigma:
            factor, unit = in_file_unit(hidden.unit)
            code = "mdb" if np.isfinite(hidden.mdb) else "unchecked"
            mdb, sigma = factor * hidden.mdb, factor * hidden.sigma
            yield Finding(code, "note", hidden.words, mdb, _HIDDEN * sigma, numbers={"sigma": sigma, "unit": unit})


def _common_biases(tables: Tables) -> Iterator[Finding]:
    """Yield the MDB of a bias common to all rows of a group, and its effect on the interior orientation."""
    for t in (t for t in tables.tested_trends if t.pattern.group):
        worst: tuple[float, str, statistics.TermEstimate] | None = None
        for h in (h for h in t.hints if h.amount != 0.0):
            for path, moved in h.moves.items():
                size = abs(moved / h.amount) * statistics.DELTA0 * h.sigma
                worst = max(worst or (0.0, "", h), (size, path, h), key=lambda w: w[0])
        if worst is not None and worst[0] > _MOVED:
            size, path, h = worst
            factor, unit = in_file_unit(t.pattern.unit)
            numbers = {"term": h.term.name, "unit": unit, "parameter": path, "moved": size}
            yield Finding(
                "common_bias", "note", t.pattern.what, factor * statistics.DELTA0 * h.sigma, _MOVED, numbers=numbers
            )


# Rejected observations -------------------------------------------------------------------------------------------

_REJECTED_SHOWN = 5
# Maximum scatter of errors with a common bias, in standard deviations.
_COMMON = 3.0


def left_out_table(snooped: Snooped, block: Block) -> pd.DataFrame:
    """Tabulate all rejected observations by decreasing error.

    Columns: group, image, point, observation, error, sigma, unit, w. `error` is the observed minus the predicted value.
    Points that were rejected completely follow without values.
    """
    groups, rows = block.named_observations, list[tuple]()
    for s in snooped.left_out:
        names = []
        for what, known in (("image", block.images), ("point", block.points)):
            found = groups[s.group].names_of(what, known)
            names.append(str(found[..., s.row] if found.ndim == 1 else found[0, s.row]))
        factor, unit = in_file_unit(s.unit)
        rows.append((s.group, *names, s.words, factor * s.error, factor * s.sigma, unit, s.w))
    rows += [("", "", point, f"point {point}", None, None, "", None) for point in snooped.points]
    columns = ["group", "image", "point", "observation", "error", "sigma", "unit", "w"]
    return pd.DataFrame(rows, columns=columns)


def snooped_findings(snooped: Snooped, block: Block) -> list[Finding]:
    """Return findings on corrected and rejected observations, systematic errors first."""
    found = [*_too_many(snooped, block)]
    found += [Finding("exchanged", "warning", exchange.words) for exchange in snooped.exchanged]
    found += _common(snooped, block)
    for s in snooped.left_out[:_REJECTED_SHOWN]:
        factor, unit = in_file_unit(s.unit)
        numbers = {"sigma": factor * s.sigma, "unit": unit, "w": s.w}
        found.append(Finding("rejected_observation", "warning", s.words, factor * s.error, numbers=numbers))
    if (more := len(snooped.left_out) - _REJECTED_SHOWN) > 0:
        found.append(Finding("rejected_more", "warning", value=more))
    if snooped.points:
        found.append(Finding("rejected_points", "warning", few(snooped.points), len(snooped.points)))
    return found


def _common(snooped: Snooped, block: Block) -> Iterator[Finding]:
    """Find rejected rows of a group (except image points) with a common bias along an axis, overall or in a strip."""
    for name, rows in block.named_observations.items():
        left = [s for s in snooped.left_out if s.group == name]
        if name == IMAGE_POINTS or isinstance(rows, Correlated) or len(left) < SEVERAL:
            continue
        axes = rows.axis_of_numbers
        strips = np.broadcast_to(rows.names_of("image", block.image_strip), axes.shape)
        of_strips = sorted({(str(axes[s.number, s.row]), str(strips[s.number, s.row])) for s in left})
        reported: set[str] = set()
        for axis, strip in [*((axis, None) for axis in dict.fromkeys(a for a, _ in of_strips)), *of_strips]:
            part = (axes == axis) & ((strips == strip) if strip is not None else True)
            own = [s for s in left if part[s.number, s.row]]
            if axis in reported or len(own) < SEVERAL or len(own) <= part.sum() / 2:
                continue
            error, sigma = (np.array([getattr(s, field) for s in own]) for field in ("error", "sigma"))
            mean = float(np.average(error, weights=sigma**-2.0))
            if float(np.sqrt(np.mean(((error - mean) / sigma) ** 2))) < _COMMON:
                # A bias of all strips is reported only once.
                reported |= {axis} if strip is None else set()
                factor, unit = in_file_unit(own[0].unit)
                subject = f"{name.replace('_', ' ')}{f' in strip {strip}' if strip else ''} along {axis}"
                numbers = {"n": len(own), "bias": factor * mean, "unit": unit}
                yield Finding("rejected_bias", "warning", subject, float(part.sum()), numbers=numbers)


def _too_many(snooped: Snooped, block: Block) -> Iterator[Finding]:
    """Find images and groups with too many rejections for isolated errors."""
    most = rejected_images(snooped, block)
    if images := [f"{block.images[k]} ({n} of {total})" for k, (n, total) in most.items()]:
        hint = "Check its point names, signs, axes, camera and station, or remove it"
        yield Finding("rejected_images", "error", few(images), len(images), hint=hint)
    for name, counts in mostly_rejected(snooped, block).items():
        many = ", ".join(f"{n} of {of} in {axis}" for axis, (n, of) in counts.items())
        hint = "Check their units, axes, names and signs, and the fixed values"
        yield Finding("rejected_group", "error", f"{name.replace('_', ' ')}, {many}", hint=hint)


# Variance components ---------------------------------------------------------------------------------------------


def component_tables(components: statistics.VarianceComponents) -> dict[str, pd.DataFrame]:
    """Return the tables variance_components and variance_component_correlation by file name.

    Columns: group, observations, redundancy, factor, sigma_factor, degrees_of_freedom, supported; and group_a, group_b,
    rho. A group whose component is not estimable has factor 1 and no sigma.
    """
    c = components
    columns = {
        "group": c.labels, "observations": c.observations, "redundancy": c.redundancy, "factor": c.factor,
        "sigma_factor": c.sigma, "degrees_of_freedom": c.degrees, "supported": c.supported,
    }  # fmt: skip
    known = [(k, label) for k, label in enumerate(c.labels) if c.supported[k]]
    rows = [(a, b, c.correlation[j, k]) for j, a in known for k, b in known if j != k]
    correlation = pd.DataFrame(rows, columns=["group_a", "group_b", "rho"])
    return {"variance_components": pd.DataFrame(columns), "variance_component_correlation": correlation}


def component_findings(
    components: statistics.VarianceComponents,
    blunders: Sequence[InflatedComponent] = (),
    weights: tuple[Tables, Tables] | None = None,
) -> list[Finding]:
    """Report components caused by blunders, missing convergence, and groups whose component is not estimable.

    `weights`: tables with the stated and with the estimated standard deviations, to report the factors, the change of
    sigma of c, and what else would explain the residuals.
    """
    found = []
    for component in blunders:
        numbers = {"words": few(list(component.words))}
        found.append(
            Finding("component_blunder", "error", component.label, component.factor, component.without, numbers=numbers)
        )
    if not components.converged:
        found.append(Finding("components_not_converged", "warning", value=components.iterations))
    elif weights is not None and components.supported.any():
        stated, estimated = weights
        found.append(_estimated_weights(components, stated, estimated))
        found += input_findings(stated, found)
        found += _other_explanations(stated, estimated)
    return found + [Finding("component", "warning", sentence) for sentence in components.warnings.values()]


def _estimated_weights(components: statistics.VarianceComponents, stated: Tables, estimated: Tables) -> Finding:
    """Report the factors of the standard deviations, and the sigma of the first c with and without them.

    Only those of matched image points are usually unknown: factors of other groups are a warning.
    """
    factors = components.sigma_factors
    worst = max(factors, key=lambda label: abs(np.log(factors[label])))
    usual = all(label.startswith(IMAGE_POINTS) and ANOTHER_UNIT < f < NOTHING_FITS for label, f in factors.items())
    labels, effect = estimated.adjusted.structure.labels, ""
    if path := next((label for label in labels if label.endswith(".c_mm")), ""):
        new, old = (float(t.covariance.shared_sigma[labels.index(path)]) for t in (estimated, stated))
        effect = f"; sigma of {path} {new:.2g} mm instead of {old:.2g} mm"
    severity: Severity = "note" if usual else "warning"
    return Finding("weights", severity, components.words, factors[worst], 1.0, numbers={"effect": effect})


def _other_explanations(stated: Tables, estimated: Tables) -> Iterator[Finding]:
    """Report effects and outliers that are significant with the stated, but not with the estimated weights.

    Each with the part of v'Pv that it explains alone, the largest first.
    """
    remaining = {e.subject for e in _systematic(estimated, True)}
    kept = {(s.group, s.row) for s in estimated.blunders.suspects}
    causes = [(e.explained, e.freedom, e.subject) for e in _systematic(stated, True) if e.subject not in remaining]
    variance = float(stated.adjusted.sigma0) ** 2
    gone = (s for s in stated.blunders.suspects if (s.group, s.row) not in kept)
    causes += [(s.w**2 * variance, 1, f"an outlier in {s.words}") for s in gone]
    if causes:
        whole = float(stated.adjusted.sum_of_squares)
        words = [f"{what} ({part:.3g}, {counted(n, 'unknown')})" for part, n, what in sorted(causes, reverse=True)]
        yield Finding("other_explanations", "note", few(words), len(causes), numbers={"whole": whole})
