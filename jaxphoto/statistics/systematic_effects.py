"""Tests of residuals for systematic effects over the image format, over time, and between strips.

Candidate effects. Over the format: polynomials of x and y up to the fifth degree (third in huge blocks); they contain
the usual lens terms (k1, k2, p1, p2, affinity, shear) exactly and most smooth fields approximately. Over time: a linear
change of the camera. For every group observed per image: a common mean, a mean per strip and a linear drift; for
positions also a common mean along the axes of the aircraft, which a wrong lever arm or a time offset causes.

Test. An effect G (one column per direction, whitened like the observations) that the model lacks changes u = G'v, which
has the cofactors C = G' Q_vv P G of whitened observations. As an unknown, G b would be estimated by b = C^-1 u. If the
model is complete, u' C^-1 u / v'v follows the beta distribution of f / 2 and (r - f) / 2, with f the rank of C and r
the redundancy; this is exact with sigma naught estimated from the same residuals. Effects absorbed by estimated
parameters do not appear in C.

Sources: Kok (1984), On data snooping and multiple outlier testing, NOAA Technical Report NOS NGS 30; Teunissen (2000),
Testing theory, 2.
"""

import bisect
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Float, Int
from numpy.polynomial import legendre

from jaxphoto.adjustment import Adjustment
from jaxphoto.adjustment.model.numbers import IMAGE_POINTS
from jaxphoto.block import Block, exposures, mountings
from jaxphoto.camera import (
    InteriorOrientation,
    RollingShutter,
    Sensor,
    get_parameter,
    parameter_names,
    set_parameter,
)
from jaxphoto.compiling import call_compiled
from jaxphoto.errors import camera_words
from jaxphoto.georeferencing import object_from_body
from jaxphoto.observations import ATTITUDE_AXES, AXES, PRIORS, AbstractObservations, Correlated
from jaxphoto.short_repr import pretty_repr
from jaxphoto.statistics.discrepancy import observation_groups
from jaxphoto.statistics.hat_matrix import HatMatrix
from jaxphoto.statistics.quantiles import beta_tail
from jaxphoto.unknowns import Unknowns

Places = Mapping[str, Int[np.ndarray, "..."]]
# Maximum number of matrix elements for fifth-degree polynomials over the format; larger blocks use third degree.
_MAX_ELEMENTS = 100_000_000
# Maximum number of observations per batch of weighted copies.
_BATCH = 50_000
MAX_GROUPS = 40
"""Maximum number of cameras, or of strips, that are tested individually: more tests reduce the power of each."""
# Number of points along each side of the grid on which terms are expanded in polynomials.
_GRID = 9
# Maximum misfit of a term's polynomial expansion, relative to the largest value of the term.
_MAX_MISFIT = 0.02

# Minimum fraction of a common shift of all stations that must remain. c and the ground absorb most of the shift, but
# the small remainder is significant.
_MIN_FRACTION_OF_SHIFT = 1e-6
_CURE_OF_SHIFT = {
    "m": "on average: another datum or height reference, or a wrong lever arm; compare with control, or "
    'estimate a shift of the flight ([unknowns.flight_bias], shift = "free")',
    "rad": "on average: another angle convention, or a boresight: set it free",
}
_CURE_OF_ARM = "on average: a wrong lever arm{}; correct it in [mounts], or free it there"
_CURE_OF_NORTH = "on average: another north (true, grid, magnetic) or vertical; compare with [frame] yaw"
_CURE_OF_STRIP = "on average: estimate a shift of that strip, or check its recording and its camera"


@pretty_repr
class EffectTerm(NamedTuple):
    """Named linear combination of the columns of a systematic effect."""

    name: str
    coefficients: Float[np.ndarray, "columns"]
    cure: str
    """Advice for messages."""
    report_amount: bool = True
    """True if messages report the size of the term, in the unit of the observations."""


class Part(NamedTuple):
    """Columns with values at the same observations."""

    at: Int[np.ndarray, "m"]
    """Indices of the observations."""
    values: Float[np.ndarray, "k m"]
    """Values in the unit of the observations."""
    weight: Float[np.ndarray, "m"]
    """One over the standard deviations of the observations."""


@pretty_repr
class SystematicEffect(NamedTuple):
    """Candidate columns of a systematic effect in the residuals, in parts."""

    what: str
    """Label for messages: "image points of camera A over the format"."""
    unit: str
    camera: str
    """Camera of the image points; "" for other observations."""
    parts: tuple[Part, ...]
    terms: tuple[EffectTerm, ...]
    begins: str = ""
    """Beginning of the message; default "residuals of `what` follow a pattern"."""
    group: str = ""
    """Group in which all rows share the effect axis by axis; "" for other effects."""
    report_all: bool = False
    """True if messages report all significant terms instead of the one that explains most."""
    min_fraction: float = 1e-3
    """Minimum fraction of a direction that estimated parameters must leave for it to be tested. Smaller remainders are
    dominated by the curvature of the model.
    """

    @property
    def n_columns(self) -> int:
        """Number of columns."""
        return sum(len(p.values) for p in self.parts)

    @property
    def rows(self) -> int:
        """Number of observations with a nonzero value in any column."""
        return len(np.unique(np.concatenate([p.at[(p.values != 0).any(axis=0)] for p in self.parts])))

    @property
    def sigma(self) -> float:
        """Median standard deviation of the observations."""
        return float(1 / np.median(np.concatenate([p.weight for p in self.parts])))

    def products(self, whitened: bool) -> Float[np.ndarray, "columns columns"]:
        """Return the products of all pairs of columns, in the unit of the observations or whitened.

        No observation is in two parts.
        """
        products, first = np.zeros((self.n_columns, self.n_columns)), 0
        for p in self.parts:
            last = first + len(p.values)
            for k in range(0, len(p.at), _BATCH):
                values = p.values[:, k : k + _BATCH] * (p.weight[k : k + _BATCH] if whitened else 1.0)
                # Use einsum instead of BLAS, whose threads block each other on a busy machine (seconds instead of
                # milliseconds).
                products[first:last, first:last] += np.einsum("in,jn->ij", values, values)
            first = last
        return products

    def column(self, k: int, count: int) -> Float[np.ndarray, "count"]:
        """Return column `k` for `count` observations, whitened."""
        column = np.zeros(count)
        for p in self.parts:
            if 0 <= k < len(p.values):
                column[p.at] = p.values[k] * p.weight
            k -= len(p.values)
        return column

    def times(self, whitened: Float[np.ndarray, "count"]) -> Float[np.ndarray, "columns"]:
        """Return the products of all columns with whitened values of all observations."""
        return np.concatenate([np.einsum("in,n->i", p.values, p.weight * whitened[p.at]) for p in self.parts])


def candidate_effects(adjusted: Adjustment, places: Places) -> Iterator[SystematicEffect]:
    """Yield all systematic effects to test in an adjustment. `places`: index of each observation by group.

    Correlated observations are not tested.
    """
    groups = observation_groups(adjusted)
    count = sum(np.size(v) for v in places.values())
    for camera in adjusted.unknowns.interior if len(adjusted.unknowns.interior) <= MAX_GROUPS else ():
        rows_of_camera = np.array(adjusted.block.image_camera)[adjusted.structure.image] == camera
        if rows_of_camera.any():
            yield _over_format(adjusted, camera, rows_of_camera, places, 5 if count * 42 <= _MAX_ELEMENTS else 3)
            if (time := _time(adjusted)) is not None:
                yield _camera_over_time(adjusted, camera, rows_of_camera, places, time[adjusted.structure.image])
    yield from _prior_contradictions(adjusted, groups, places)
    for name, observations in groups.items():
        if name != IMAGE_POINTS and observations.unit and not isinstance(observations, Correlated):
            yield from _by_strip(adjusted, name, observations, places)


def _prior_contradictions(
    adjusted: Adjustment, groups: Mapping[str, AbstractObservations], places: Places
) -> Iterator[SystematicEffect]:
    """Yield the deviations of the parameters of each camera from their prior information."""
    by_camera: dict[str, list[tuple[str, np.ndarray, np.ndarray]]] = {}
    interior_parameters = {
        f"interior[{camera}].{name}": (camera, name)
        for camera, interior in adjusted.unknowns.interior.items()
        for name in parameter_names(interior)
    }
    labels = adjusted.parameters
    for name, rows in groups.items():
        if name.startswith(PRIORS):
            # Columns of L^-1: a whitened unit change of each parameter.
            sigma = np.asarray(rows.sigmas).ravel()
            whitener = np.asarray(rows.whitener)[0] if isinstance(rows, Correlated) else np.diag(1 / sigma)
            (_, parameters), *_ = rows.indices()
            for k, column in zip(np.ravel(parameters), whitener.T, strict=True):
                if (label := labels[k]) in interior_parameters:
                    camera, parameter = interior_parameters[label]
                    by_camera.setdefault(camera, []).append((parameter, places[name].ravel(), column))
    for camera, priors in by_camera.items():
        places_of_camera = np.unique(np.concatenate([at for _, at, _ in priors]))
        values = np.zeros((len(priors), len(places_of_camera)))
        for k, (_, at, column) in enumerate(priors):
            values[k, np.searchsorted(places_of_camera, at)] = column
        cure = (
            "the camera has changed since (focus, lens, temperature), or the standard deviations of one are too small: "
            "compare with a calibration of this block alone (jaxphoto compare)"
        )
        columns = np.eye(len(priors))
        terms = tuple(EffectTerm(p, c, cure) for (p, *_), c in zip(priors, columns, strict=True))
        yield SystematicEffect(
            f"prior information of {camera_words(camera)}", "", "",
            (Part(places_of_camera, values, np.ones(len(places_of_camera))),),
            terms, begins=f"this block contradicts the prior information of {camera_words(camera)}",
        )  # fmt: skip


def _over_format(adjusted: Adjustment, camera: str, rows: np.ndarray, places: Places, degree: int) -> SystematicEffect:
    sensor, interior = adjusted.block.sensors[camera], adjusted.unknowns.interior[camera]
    values = _polynomials(_in_format(sensor, np.asarray(adjusted.values.xy)[:, rows]), degree)
    parts = _parts_of_image(adjusted, rows, places, (values, values))
    sides = np.linspace(-1.0, 1.0, _GRID) * np.array([sensor.width_mm, sensor.height_mm])[:, None] / 2
    grid = np.stack([v.ravel() for v in np.meshgrid(*sides)])
    inverse = np.linalg.pinv(_polynomials(_in_format(sensor, grid), degree).T)
    terms, basis = [], np.linalg.pinv(inverse)
    for name, field in _fields(interior, grid):
        coefficients = np.stack([inverse @ f for f in field])
        # Omit terms that polynomials of this degree cannot represent.
        if np.abs(coefficients @ basis.T - field).max() < _MAX_MISFIT * np.abs(field).max():
            cure = _cure(adjusted, camera, name)
            if cure and _is_affine(field, grid - np.asarray(interior.principal_point)[:, None]):
                cure += _CURE_ROLLING * (camera not in adjusted.unknowns.more.get(RollingShutter.kind, {}))
            terms.append(EffectTerm(name, coefficients.ravel(), cure, False))
    return SystematicEffect(
        f"image points of {camera_words(camera)} over the format", "mm", camera, parts, tuple(terms)
    )


def _camera_over_time(
    adjusted: Adjustment, camera: str, rows: np.ndarray, places: Places, time: np.ndarray
) -> SystematicEffect:
    """Return a linear change of c and the principal point over time, in mm from the first to the last image."""
    interior, t = adjusted.unknowns.interior[camera], time[rows]
    x, y = (np.asarray(adjusted.values.xy)[:, rows] - np.asarray(interior.principal_point)[:, None]) / float(interior.c)
    zero = np.zeros_like(t)
    columns = (np.stack([x * t, t, zero]), np.stack([y * t, zero, t]))
    # x and y have the same columns, so they form one part.
    (at_x, x_values, x_weight), (at_y, y_values, y_weight) = _parts_of_image(adjusted, rows, places, columns)
    joint = Part(np.append(at_x, at_y), np.hstack([x_values, y_values]), np.append(x_weight, y_weight))
    names = ("c", "x_p", "y_p")
    cure = "from the first image to the last: the camera changes in flight: estimate parameters of shorter periods"
    terms = tuple(EffectTerm(name, column, cure) for name, column in zip(names, np.eye(3), strict=True))
    return SystematicEffect(f"image points of {camera_words(camera)} over time", "mm", camera, (joint,), terms)


def _parts_of_image(
    adjusted: Adjustment, rows: np.ndarray, places: Places, values: tuple[np.ndarray, ...]
) -> tuple[Part, ...]:
    """Return the parts of the x and of the y coordinates of some image rows."""
    sigma, at = np.asarray(adjusted.values.sigma_xy)[:, rows], places[IMAGE_POINTS][:, rows]
    return tuple(Part(places_xy, v, 1 / s) for places_xy, v, s in zip(at, values, sigma, strict=True))


def _by_strip(
    adjusted: Adjustment, name: str, rows: AbstractObservations, places: Places
) -> Iterator[SystematicEffect]:
    """Yield common mean, mean per strip and linear drift of each axis.

    Only for groups in which every row belongs to one image.
    """
    block, at = adjusted.block, np.atleast_2d(places[name])
    image_number = rows.names_of("image", [str(k) for k in range(len(block.images))])
    if not len(image_number) or not all(n.isdigit() for n in image_number):
        return
    image = np.broadcast_to(image_number.astype(int), at.shape)
    axis = np.broadcast_to(rows.axis_names(), at.shape)
    sigma = np.broadcast_to(np.asarray(rows.sigmas).T, at.shape)
    strips = np.array(block.image_strip, object)[image]
    axes, labels = list(dict.fromkeys(axis.ravel())), list(dict.fromkeys(strips[strips != ""].ravel()))
    weight = 1 / sigma
    group = name.replace("_", " ")

    def effect(what: str, columns: list[tuple[str, np.ndarray]], cure: str, **options: Any) -> SystematicEffect:
        values = np.stack([v.ravel() for _, v in columns])
        # Columns without common observations are parts of their own.
        joint = (values != 0).sum(axis=0).max() > 1
        parts = tuple(Part(at.ravel(), v, weight.ravel()) for v in ([values] if joint else values[:, None]))
        units = np.eye(len(columns))
        terms = tuple(EffectTerm(n, unit, cure) for (n, _), unit in zip(columns, units, strict=True))
        return SystematicEffect(f"{group} {what}", rows.unit, "", parts, terms, **options)

    means = [(str(a), (axis == a).astype(float)) for a in axes]
    cure = _CURE_OF_SHIFT.get(rows.unit, "")
    common = {"report_all": True, "min_fraction": _MIN_FRACTION_OF_SHIFT}
    yield effect("as a whole", means, cure, group=name, **common)

    if rows.unit == "m" and set(axes) <= set(AXES):
        number, speed = (axis[..., None] == np.array(AXES)).argmax(axis=-1), flight_speed(block, adjusted.unknowns)
        body = body_attitudes(block, adjusted.unknowns)[image, number]
        arms = [(a, body[..., k]) for k, a in enumerate(("right", "forward", "up"))]
        offset = f" or time offset (1 s is {speed:.3g} m forward)" if speed else ""
        yield effect("along the axes of the aircraft", arms, _CURE_OF_ARM.format(offset), **common)
    elif set(axes) == set(ATTITUDE_AXES):
        number = (axis[..., None] == np.array(ATTITUDE_AXES)).argmax(axis=-1)
        # Residuals are rotations about the forward, right and down axes of the aircraft.
        about = (body_attitudes(block, adjusted.unknowns)[..., [1, 0, 2]] * [1.0, 1.0, -1.0])[image, :, number]
        turns = [(a, about[..., k]) for k, a in enumerate(AXES)]
        yield effect("about the axes of the object frame", turns, _CURE_OF_NORTH, **common)
    if 1 < len(labels) <= MAX_GROUPS:
        columns = [(f"{a} of strip {s}", ((strips == s) & (axis == a)).astype(float)) for s in labels for a in axes]
        yield effect("from strip to strip", columns, _CURE_OF_STRIP)
    if (time := _time(adjusted)) is not None:
        drifts = [(a, np.where(axis == a, time[image], 0.0)) for a in axes]
        yield effect("over time", drifts, "from the first image to the last: estimate shifts or drifts of the strips")


def _time(adjusted: Adjustment) -> Float[np.ndarray, "images"] | None:
    """Return the time of each image, scaled to -0.5 at the first and 0.5 at the last; None without times."""
    block = adjusted.block
    time = np.asarray(block.image_time if block.flight_time is None else block.flight_time)
    span = np.ptp(time)
    return (time - time.min()) / span - 0.5 if span > 0 else None


def body_attitudes(block: Block, unknowns: Unknowns) -> Float[np.ndarray, "images 3 3"]:
    """Return `object_from_body` at each image; its columns are the right, forward and up axes of the aircraft."""
    mounts, _ = mountings(block, unknowns)
    orientation = unknowns.exterior.camera_from_object
    return np.asarray(call_compiled(_bodies, orientation, mounts.boresight, exposures(block).nominal))


@eqx.filter_jit
def _bodies(orientation: Array, boresight: Array, nominal: Array) -> Array:
    return jax.vmap(object_from_body)(orientation, boresight, nominal)


def flight_speed(block: Block, unknowns: Unknowns) -> float:
    """Return the median speed between successive images of a strip (m/s); 0 if unknown."""
    time, strip = np.asarray(block.image_time), np.array(block.image_strip)
    position, order = np.asarray(unknowns.exterior.position), np.lexsort((time, strip))
    step, distance = np.diff(time[order]), np.linalg.norm(np.diff(position[order], axis=0), axis=1)
    within = (strip[order][1:] == strip[order][:-1]) & (strip[order][1:] != "") & (step > 0)
    return float(np.median(distance[within] / step[within])) if within.any() else 0.0


def _in_format(sensor: Sensor, xy: Float[np.ndarray, "2 n"]) -> Float[np.ndarray, "2 n"]:
    return xy / np.array([sensor.width_mm, sensor.height_mm])[:, None] * 2


def _polynomials(xy: Float[np.ndarray, "2 n"], degree: int) -> Float[np.ndarray, "k n"]:
    """Evaluate the products of Legendre polynomials of x and y up to a total degree."""
    x, y = (legendre.legvander(v, degree).T for v in xy)
    return np.stack([x[i] * y[j] for i in range(degree + 1) for j in range(degree + 1 - i)])


_CURE_ROLLING = ", or estimate a rolling shutter, with a similar effect (docs/time_dependent_cameras.md)"
# Terms of Brown's model (docs/models.md), tested if the camera model lacks them.
_BROWN_TERMS = {
    "k1": lambda x, y: (x * (x * x + y * y), y * (x * x + y * y)),
    "k2": lambda x, y: (x * (x * x + y * y) ** 2, y * (x * x + y * y) ** 2),
    "p1": lambda x, y: (3 * x * x + y * y, 2 * x * y),
    "p2": lambda x, y: (2 * x * y, x * x + 3 * y * y),
    "b1 (affinity)": lambda x, y: (x, 0 * x),
    "b2 (shear)": lambda x, y: (y, 0 * x),
}


def _fields(
    interior: InteriorOrientation, grid: Float[np.ndarray, "2 n"]
) -> list[tuple[str, Float[np.ndarray, "2 n"]]]:
    """Return the displacement field of each camera parameter and of the Brown terms that the model lacks."""
    centred = grid - np.asarray(interior.principal_point)[:, None]
    names = parameter_names(interior)
    values = np.array([float(get_parameter(interior, name)) for name in names])
    slopes = np.asarray(call_compiled(_slopes, interior, names, values, centred.T))
    unit, zero = np.ones(grid.shape[1]), np.zeros(grid.shape[1])
    # Use scale and shifts of the model without distortion: the contribution of the distortion to them is negligible.
    fields = {"c_mm": centred / float(interior.c), "xp_mm": np.stack([unit, zero]), "yp_mm": np.stack([zero, unit])}
    fields = {name: slopes[..., k].T for k, name in enumerate(names)} | fields
    brown = {name: np.stack(field(*centred)) for name, field in _BROWN_TERMS.items() if name.split()[0] not in names}
    return [(name, field) for name, field in (fields | brown).items() if np.isfinite(field).all()]


@eqx.filter_jit
def _slopes(interior: InteriorOrientation, names: tuple[str, ...], values: Array, xy: Array) -> Array:
    """Return the derivatives of the measured or ideal coordinate (whichever has a closed form) by each parameter."""

    def coordinate(v: Array, point: Array) -> Array:
        camera = interior
        for name, value in zip(names, v, strict=True):
            camera = set_parameter(camera, name, value)
        return camera.closed_form(point)

    return jax.vmap(jax.jacfwd(coordinate), in_axes=(None, 0))(values, xy)


def _is_affine(field: Float[np.ndarray, "2 n"], centred: Float[np.ndarray, "2 n"]) -> bool:
    """Return True if the field stretches or shears the image, as a rolling shutter does."""
    matrix = field @ np.linalg.pinv(centred)
    stretched = np.abs(matrix - np.eye(2) * np.trace(matrix) / 2).max() > _MAX_MISFIT * np.abs(matrix).max()
    return bool(stretched and np.abs(matrix @ centred - field).max() < _MAX_MISFIT * np.abs(field).max())


def _cure(adjusted: Adjustment, camera: str, name: str) -> str:
    interior = adjusted.unknowns.interior[camera]
    if name not in parameter_names(interior):
        return f"which the distortion {interior.distortion.name} lacks: choose one that has it"
    return "which is fixed: free it" if f"interior[{camera}].{name}" not in adjusted.structure.labels else ""


MIN_FRACTION = 1e-3
"""Minimum fraction of an error in one observation that estimated parameters must leave for it to be tested."""
SIGNIFICANT_RATIO = 3.3
"""Ratio of a term to its standard deviation above which it is reported (error probability 0.1 %)."""
# Maximum number of blunders estimated along with an effect; more blunders are caused by the effect itself.
_MAX_BLUNDERS = 16
# Maximum relative difference between a blunder and the value of a term for the two to match.
_MATCH = 0.5


@pretty_repr
class TermEstimate(NamedTuple):
    """Estimate of one term of a systematic effect, without the other terms."""

    term: EffectTerm
    share: float
    """Fraction of the sum of squares of the whole effect, 0 to 1."""
    amount: float
    sigma: float
    """A posteriori standard deviation; `amount` and `sigma` are in the unit of the term."""
    moves: dict[str, float]
    """Change of the interior parameters due to the term, in their standard deviations, by path."""


@pretty_repr
class EffectTest(NamedTuple):
    """Test of one systematic effect."""

    pattern: SystematicEffect
    """Tested effect without its columns (hundreds of MB in a large block); `candidate_effects` recomputes them."""
    sigma: float
    """Median standard deviation of the observations of the effect."""
    freedom: int
    p_value: float
    size: float
    """Root mean square of the effect in the residuals, corrected for noise, in the unit of the observations."""
    explained: float
    """Reduction of v'Pv by the effect."""
    hints: tuple[TermEstimate, ...]
    """Estimated named terms, largest fraction first."""
    matching_blunders: int = 0
    """Number of estimated blunders that match the value of the first term at their observations."""

    @property
    def significant_terms(self) -> list[TermEstimate]:
        """Significant terms of an effect with `report_all`; empty for other effects."""
        significant = [h for h in self.hints if abs(h.amount) > SIGNIFICANT_RATIO * h.sigma]
        return significant if self.pattern.report_all else []


def systematic_effect_tests(
    adjusted: Adjustment, shared_sigma: Float[np.ndarray, "shared"], blunders: Sequence[tuple[str, int]] = ()
) -> list[EffectTest]:
    """Test all candidate effects of `adjusted`. Significant effects have a small `p_value`.

    `shared_sigma`: a posteriori standard deviations of the shared unknowns. `blunders`: rows as group name and index;
    up to 16 of them, the first, are estimated as unknown errors along with each effect.
    """
    if adjusted.redundancy < 2 or not bool(adjusted.converged):
        return []
    hat_matrix = HatMatrix.of(adjusted)
    v = hat_matrix.residuals
    rows = [np.ravel(hat_matrix.places[name][..., row]) for name, row in blunders[:_MAX_BLUNDERS]]
    directions = _Directions(
        np.concatenate([np.zeros(0, int), *rows]),
        tuple(candidate_effects(adjusted, hat_matrix.places)),
        hat_matrix.count,
    )
    adjusted_products, changes = hat_matrix.products(directions.column, directions.ends[-1])
    changes = changes / np.where(shared_sigma > 0, shared_sigma, np.inf)
    blunder_errors = _Blunders.of(directions.at, v, adjusted_products, changes)
    indices = range(len(directions.patterns))
    tests = [_tested(adjusted, directions, k, v, blunder_errors, adjusted_products, changes) for k in indices]
    return [test for test in tests if test is not None]


class _Directions(NamedTuple):
    """Right-hand sides solved together: a unit error in each of some observations, then the columns of each effect."""

    at: Int[np.ndarray, "m"]
    patterns: tuple[SystematicEffect, ...]
    n_observations: int

    @property
    def ends(self) -> list[int]:
        """End index of the observations, then of each effect."""
        return np.cumsum([len(self.at), *(p.n_columns for p in self.patterns)]).tolist()

    def column(self, k: int) -> Float[np.ndarray, "n"]:
        """Return direction `k`, whitened."""
        effect = bisect.bisect_right(self.ends, k)
        if effect == 0:
            return self.unit(k)
        return self.patterns[effect - 1].column(k - self.ends[effect - 1], self.n_observations)

    def unit(self, k: int) -> Float[np.ndarray, "n"]:
        """Return a whitened unit error in observation `at[k]`."""
        return np.bincount(self.at[k : k + 1], minlength=self.n_observations).astype(float)


class _Blunders(NamedTuple):
    """Observations with errors estimated as unknowns."""

    errors: Float[np.ndarray, "m"]
    """Estimated errors, whitened."""
    changes: Float[np.ndarray, "m shared"]
    inverse: Float[np.ndarray, "m m"]
    explained: float
    freedom: int

    @classmethod
    def of(
        cls,
        at: Int[np.ndarray, "m"],
        v: Float[np.ndarray, "n"],
        adjusted_products: Float[np.ndarray, "k k"],
        changes: Float[np.ndarray, "k shared"],
    ) -> "_Blunders":
        """Estimate the errors of the observations `at`, the first directions."""
        m = len(at)
        inverse, freedom = truncated_inverse(np.eye(m) - adjusted_products[:m, :m], np.eye(m), MIN_FRACTION)
        errors = inverse @ v[at]
        return cls(errors, changes[:m], inverse, float(v[at] @ errors), freedom)


def _tested(
    adjusted: Adjustment,
    directions: _Directions,
    k: int,
    v: Float[np.ndarray, "n"],
    blunders: _Blunders,
    adjusted_products: Float[np.ndarray, "k k"],
    changes: Float[np.ndarray, "k shared"],
) -> EffectTest | None:
    pattern, (first, last), m = directions.patterns[k], directions.ends[k : k + 2], len(directions.at)
    unadjusted = pattern.products(whitened=True)
    units = [pattern.times(directions.unit(i)) for i in range(m)]
    cross = np.reshape(units, (m, pattern.n_columns)).T - adjusted_products[first:last, :m]
    u = pattern.times(v) - cross @ blunders.errors
    c = unadjusted - adjusted_products[first:last, first:last] - cross @ blunders.inverse @ cross.T
    changes = changes[first:last] - cross @ blunders.inverse @ blunders.changes
    inverse, freedom = truncated_inverse(c, unadjusted, pattern.min_fraction)
    sum_of_squares, redundancy = float(v @ v) - blunders.explained, adjusted.redundancy - blunders.freedom
    if freedom == 0 or redundancy <= freedom or sum_of_squares <= 0:
        return None
    explained, b, sigma0 = float(u @ inverse @ u), inverse @ u, (sum_of_squares / redundancy) ** 0.5
    column_products = pattern.products(whitened=False)
    size2 = (b @ column_products @ b - sigma0**2 * np.sum(column_products * inverse)) / pattern.rows
    hints = _hints(adjusted, pattern, u, c, unadjusted, changes, sigma0)
    hints = [hint._replace(share=hint.share / explained) for hint in hints]
    p = beta_tail(explained / sum_of_squares, freedom / 2, (redundancy - freedom) / 2)
    hints.sort(key=lambda h: -h.share)
    matching = 0
    if hints and m:
        values = hints[0].amount * (np.array(units) @ hints[0].term.coefficients)
        matching = int((np.abs(blunders.errors - values) < _MATCH * np.abs(values)).sum())
    label = pattern._replace(parts=())
    size = max(float(size2), 0.0) ** 0.5
    return EffectTest(label, pattern.sigma, freedom, p, size, explained, tuple(hints), matching)


def _hints(
    adjusted: Adjustment,
    pattern: SystematicEffect,
    u: Float[np.ndarray, "k"],
    c: Float[np.ndarray, "k k"],
    unadjusted: Float[np.ndarray, "k k"],
    changes: Float[np.ndarray, "k shared"],
    sigma0: float,
) -> list[TermEstimate]:
    """Estimate each term without the others, with its sum of squares as `share`.

    Terms absorbed by estimated parameters are omitted.
    """
    estimates = []
    paths = [(k, label) for k, label in enumerate(adjusted.structure.labels) if label.startswith("interior[")]
    for term in pattern.terms:
        a = term.coefficients
        precision, total = float(a @ c @ a), float(a @ unadjusted @ a)
        if precision <= pattern.min_fraction * total:
            continue
        amount = float(a @ u) / precision
        moves = {label: float(amount * (a @ changes[:, k])) for k, label in paths}
        estimates.append(TermEstimate(term, float(a @ u) ** 2 / precision, amount, sigma0 / precision**0.5, moves))
    return estimates


def truncated_inverse(
    c: Float[np.ndarray, "k k"], unadjusted: Float[np.ndarray, "k k"], min_fraction: float
) -> tuple[Float[np.ndarray, "k k"], int]:
    """Return the pseudoinverse of `c` over the directions that estimated parameters do not absorb, and its rank.

    `unadjusted` is `c` without estimated parameters.
    """
    if not np.isfinite(c).all():
        # Overflow: no direction is testable.
        return np.zeros_like(c), 0
    size = np.sqrt(np.diagonal(unadjusted))
    unit = np.where(size > 0, 1 / np.where(size > 0, size, 1.0), 0.0)
    values, vectors = np.linalg.eigh(c * unit[:, None] * unit)
    testable = values > min_fraction
    half = vectors[:, testable] / np.sqrt(values[testable]) * unit[:, None]
    return half @ half.T, int(testable.sum())
