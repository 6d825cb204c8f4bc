"""Patterns that residuals may follow where a model lacks something, and the terms by which a sentence can name them.

Over the format, polynomials of x and y up to the fifth degree, the third in huge blocks: the first hold the usual lens
terms (k1, k2, p1, p2, affinity, shear) exactly and most of what is smooth. Over time, a camera that changes evenly;
as a whole, from strip to strip and over time, a mean and an even drift of whatever was observed of images.


Do residuals follow a pattern: over the format of a camera, over time, from strip to strip?

A pattern G (one column a direction, in the unit of the observations, whitened like them) that the model lacks shows in
u = G'v with the cofactors C = G' Q_vv P G of whitened observations: G b would be estimated as b = C^-1 u, if it were
unknown. Where the model lacks nothing, u' C^-1 u / v'v follows the beta distribution of f / 2 and (r - f) / 2, f the
rank of C, r the redundancy: exactly, with sigma naught estimated from the same residuals. What estimated parameters
can take up, C does not see.

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
from jaxphoto.observations import PRIORS, AbstractObservations, Correlated
from jaxphoto.short_repr import shown
from jaxphoto.statistics.discrepancy import observation_groups
from jaxphoto.statistics.hat_matrix import Responses
from jaxphoto.statistics.quantiles import beta_tail

Places = Mapping[str, Int[np.ndarray, "..."]]
# Numbers of all polynomials over a format together, beyond which those of the third degree do: seconds, and memory.
_MOST = 100_000_000
# Observations whose weighted copies are in memory.
_AT_ONCE = 50_000
MOST_PARTS = 40
"""Cameras, or strips, beyond which they are not judged one by one: the more tests, the less each can show."""
# Of the grid on which terms are written as polynomials, along a side.
_GRID = 9
# Of a term's largest number, what its polynomials may miss.
_EXACT = 0.02

# What all stations have in common nearly all goes into c and the ground, and what is left speaks clearly nonetheless.
_ALIKE = 1e-6
_OF_ALL = {
    "m": "on the average: another datum or kind of height, or a wrong lever arm; compare with control, or let the "
    'flight shift ([unknowns.flight_bias], shift = "free")',
    "rad": "on the average: another convention of angles, or a boresight, which can be free",
}
_OF_A_STRIP = "on the average: let that strip shift, or look at its recording and at the camera that it names"


@shown
class PatternTerm(NamedTuple):
    """A combination of the columns of a pattern that has a name."""

    name: str
    coefficients: Float[np.ndarray, "columns"]
    cure: str
    """What a sentence says of it, and advises."""
    amount_told: bool = True
    """Whether a sentence says how large it is: in the unit of the observations."""


class Part(NamedTuple):
    """Columns that have numbers at the same observations."""

    at: Int[np.ndarray, "m"]
    """Places in the list of all observations."""
    values: Float[np.ndarray, "k m"]
    """In the unit of the observations."""
    weight: Float[np.ndarray, "m"]
    """One over their standard deviations."""


@shown
class ResidualPattern(NamedTuple):
    """Columns of numbers that residuals may follow, part by part."""

    what: str
    """What a sentence calls it: "image points of camera A over the format"."""
    unit: str
    camera: str
    """Whose image points they are; "" where they are none."""
    parts: tuple[Part, ...]
    terms: tuple[PatternTerm, ...]
    begins: str = ""
    """How a sentence begins, where it is not "residuals of `what` follow a pattern"."""
    group: str = ""
    """Where its terms are what all rows of one group are off by alike, axis by axis, the name of that."""
    least_seen: float = 1e-3
    """Directions of which estimated parameters take up all but this are no part of the test: in what is left of them
    the curvature of the model shows."""

    @property
    def many(self) -> int:
        """Columns."""
        return sum(len(p.values) for p in self.parts)

    @property
    def rows(self) -> int:
        """Observations that have a part in it."""
        return len(np.unique(np.concatenate([p.at[(p.values != 0).any(axis=0)] for p in self.parts])))

    @property
    def sigma(self) -> float:
        """The median standard deviation of these."""
        return float(1 / np.median(np.concatenate([p.weight for p in self.parts])))

    def products(self, whitened: bool) -> Float[np.ndarray, "columns columns"]:
        """Of all columns with one another, in the unit or whitened; those of different parts share no observation."""
        found, first = np.zeros((self.many, self.many)), 0
        for p in self.parts:
            last = first + len(p.values)
            for k in range(0, len(p.at), _AT_ONCE):
                values = p.values[:, k : k + _AT_ONCE] * (p.weight[k : k + _AT_ONCE] if whitened else 1.0)
                # Not by BLAS, whose threads wait for one another on a busy machine: seconds for milliseconds' work.
                found[first:last, first:last] += np.einsum("in,jn->ij", values, values)
            first = last
        return found

    def column(self, k: int, count: int) -> Float[np.ndarray, "count"]:
        """Column `k` of `count` observations, whitened."""
        found = np.zeros(count)
        for p in self.parts:
            if 0 <= k < len(p.values):
                found[p.at] = p.values[k] * p.weight
            k -= len(p.values)
        return found

    def times(self, whitened: Float[np.ndarray, "count"]) -> Float[np.ndarray, "columns"]:
        """Products of all columns with whitened numbers of all observations."""
        return np.concatenate([np.einsum("in,n->i", p.values, p.weight * whitened[p.at]) for p in self.parts])


def patterns_of(adjusted: Adjustment, places: Places) -> Iterator[ResidualPattern]:
    """All that can be looked for in an adjustment; `places` numbers the observations.

    What a covariance joins is not looked at.
    """
    groups = observation_groups(adjusted)
    count = sum(np.size(v) for v in places.values())
    for camera in adjusted.unknowns.interior if len(adjusted.unknowns.interior) <= MOST_PARTS else ():
        mine = np.array(adjusted.block.image_camera)[adjusted.structure.image] == camera
        if mine.any():
            yield _over_format(adjusted, camera, mine, places, 5 if count * 42 <= _MOST else 3)
            if (time := _time(adjusted)) is not None:
                yield _camera_over_time(adjusted, camera, mine, places, time[adjusted.structure.image])
    yield from _known_before(adjusted, groups, places)
    for name, rows in groups.items():
        if name != IMAGE_POINTS and rows.unit and not isinstance(rows, Correlated):
            yield from _by_strip(adjusted, name, rows, places)


def _known_before(
    adjusted: Adjustment, groups: Mapping[str, AbstractObservations], places: Places
) -> Iterator[ResidualPattern]:
    """Whatever the parameters of a camera may be off by from what was known of them beforehand."""
    of_camera: dict[str, list[tuple[str, np.ndarray, np.ndarray]]] = {}
    own = {
        f"interior[{camera}].{name}": (camera, name)
        for camera, interior in adjusted.unknowns.interior.items()
        for name in parameter_names(interior)
    }
    labels = adjusted.parameters
    for name, rows in groups.items():
        if name.startswith(PRIORS):
            # What a change of each parameter is, whitened: the columns of L^-1.
            sigma = np.asarray(rows.sigmas).ravel()
            whitener = np.asarray(rows.whitener)[0] if isinstance(rows, Correlated) else np.diag(1 / sigma)
            (_, parameters), *_ = rows.indices()
            for k, column in zip(np.ravel(parameters), whitener.T, strict=True):
                if (label := labels[k]) in own:
                    camera, parameter = own[label]
                    of_camera.setdefault(camera, []).append((parameter, places[name].ravel(), column))
    for camera, known in of_camera.items():
        every = np.unique(np.concatenate([at for _, at, _ in known]))
        values = np.zeros((len(known), len(every)))
        for k, (_, at, column) in enumerate(known):
            values[k, np.searchsorted(every, at)] = column
        cure = (
            "the camera has changed since (focus, lens, temperature), or one of the two is less certain than it says: "
            "compare with a calibration of this block alone (jaxphoto compare)"
        )
        one = np.eye(len(known))
        terms = tuple(PatternTerm(p, c, cure) for (p, *_), c in zip(known, one, strict=True))
        yield ResidualPattern(
            f"what was known of {camera_words(camera)} beforehand", "", "", (Part(every, values, np.ones(len(every))),),
            terms, begins=f"this block contradicts what was known of {camera_words(camera)} beforehand",
        )  # fmt: skip


def _over_format(adjusted: Adjustment, camera: str, mine: np.ndarray, places: Places, degree: int) -> ResidualPattern:
    sensor, interior = adjusted.block.sensors[camera], adjusted.unknowns.interior[camera]
    values = _polynomials(_in_format(sensor, np.asarray(adjusted.values.xy)[:, mine]), degree)
    parts = _parts_of_image(adjusted, mine, places, (values, values))
    side = np.linspace(-1.0, 1.0, _GRID) * np.array([sensor.width_mm, sensor.height_mm])[:, None] / 2
    grid = np.stack([v.ravel() for v in np.meshgrid(*side)])
    inverse = np.linalg.pinv(_polynomials(_in_format(sensor, grid), degree).T)
    terms, basis = [], np.linalg.pinv(inverse)
    for name, field in _fields(interior, grid):
        coefficients = np.stack([inverse @ f for f in field])
        # What the polynomials cannot tell from a term of fewer degrees has no name here.
        if np.abs(coefficients @ basis.T - field).max() < _EXACT * np.abs(field).max():
            cure = _cure(adjusted, camera, name)
            if cure and _is_affine(field, grid - np.asarray(interior.principal_point)[:, None]):
                cure += _OR_ROLLING * (camera not in adjusted.unknowns.more.get(RollingShutter.kind, {}))
            terms.append(PatternTerm(name, coefficients.ravel(), cure, False))
    return ResidualPattern(f"image points of {camera_words(camera)} over the format", "mm", camera, parts, tuple(terms))


def _camera_over_time(
    adjusted: Adjustment, camera: str, mine: np.ndarray, places: Places, time: np.ndarray
) -> ResidualPattern:
    """c and the principal point that change evenly, by so many mm from the first to the last image."""
    interior, t = adjusted.unknowns.interior[camera], time[mine]
    x, y = (np.asarray(adjusted.values.xy)[:, mine] - np.asarray(interior.principal_point)[:, None]) / float(interior.c)
    none = np.zeros_like(t)
    columns = (np.stack([x * t, t, none]), np.stack([y * t, none, t]))
    # The same columns of x and of y: one part, of which each column has both.
    (at_x, x_values, x_weight), (at_y, y_values, y_weight) = _parts_of_image(adjusted, mine, places, columns)
    both = Part(np.append(at_x, at_y), np.hstack([x_values, y_values]), np.append(x_weight, y_weight))
    names = ("c", "x_p", "y_p")
    cure = "from the first image to the last: the camera changes in flight, give it parameters of shorter times"
    terms = tuple(PatternTerm(name, one, cure) for name, one in zip(names, np.eye(3), strict=True))
    return ResidualPattern(f"image points of {camera_words(camera)} over time", "mm", camera, (both,), terms)


def _parts_of_image(
    adjusted: Adjustment, mine: np.ndarray, places: Places, values: tuple[np.ndarray, ...]
) -> tuple[Part, ...]:
    """Of the x and of the y coordinates of some image rows."""
    sigma, at = np.asarray(adjusted.values.sigma_xy)[:, mine], places[IMAGE_POINTS][:, mine]
    return tuple(Part(own, v, 1 / s) for own, v, s in zip(at, values, sigma, strict=True))


def _by_strip(adjusted: Adjustment, name: str, rows: AbstractObservations, places: Places) -> Iterator[ResidualPattern]:
    """The mean of all, of each strip, and an even drift, of each axis of rows that are of one image."""
    block, at = adjusted.block, np.atleast_2d(places[name])
    number = rows.names_of("image", [str(k) for k in range(len(block.images))])
    if not len(number) or not all(n.isdigit() for n in number):
        return
    image = np.broadcast_to(number.astype(int), at.shape)
    axis = np.broadcast_to(rows.axis_names(), at.shape)
    sigma = np.broadcast_to(np.asarray(rows.sigmas).T, at.shape)
    strips = np.array(block.image_strip, object)[image]
    axes, of = list(dict.fromkeys(axis.ravel())), list(dict.fromkeys(strips[strips != ""].ravel()))
    weight = 1 / sigma
    thing = name.replace("_", " ")

    def pattern(what: str, columns: list[tuple[str, np.ndarray]], cure: str, **more: Any) -> ResidualPattern:
        parts = tuple(Part(at.ravel(), v.ravel()[None], weight.ravel()) for _, v in columns)
        terms = tuple(PatternTerm(n, one, cure) for (n, _), one in zip(columns, np.eye(len(columns)), strict=True))
        return ResidualPattern(f"{thing} {what}", rows.unit, "", parts, terms, **more)

    every = [(str(a), (axis == a).astype(float)) for a in axes]
    yield pattern("as a whole", every, _OF_ALL.get(rows.unit, ""), group=name, least_seen=_ALIKE)

    if 1 < len(of) <= MOST_PARTS:
        each = [(f"{a} of strip {s}", ((strips == s) & (axis == a)).astype(float)) for s in of for a in axes]
        yield pattern("from strip to strip", each, _OF_A_STRIP)
    if (time := _time(adjusted)) is not None:
        over = [(a, np.where(axis == a, time[image], 0.0)) for a in axes]
        yield pattern("over time", over, "from the first image to the last: let strips shift or drift")


def _time(adjusted: Adjustment) -> Float[np.ndarray, "images"] | None:
    """Of each image, -0.5 at the first and 0.5 at the last; None where times are not told."""
    block = adjusted.block
    time = np.asarray(block.image_time if block.flight_time is None else block.flight_time)
    span = np.ptp(time)
    return (time - time.min()) / span - 0.5 if span > 0 else None


def _in_format(sensor: Sensor, xy: Float[np.ndarray, "2 n"]) -> Float[np.ndarray, "2 n"]:
    return xy / np.array([sensor.width_mm, sensor.height_mm])[:, None] * 2


def _polynomials(xy: Float[np.ndarray, "2 n"], degree: int) -> Float[np.ndarray, "k n"]:
    """Products of Legendre polynomials of x and y, up to a total degree."""
    x, y = (legendre.legvander(v, degree).T for v in xy)
    return np.stack([x[i] * y[j] for i in range(degree + 1) for j in range(degree + 1 - i)])


_OR_ROLLING = ", or estimate a rolling shutter, which stretches the image likewise (docs/rolling_shutter.md)"
# Of Brown's model (docs/models.md), for cameras whose own model lacks them.
_USUAL = {
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
    """What each parameter of the camera does to the image, and the usual terms that it has not."""
    centred = grid - np.asarray(interior.principal_point)[:, None]
    names = parameter_names(interior)
    values = np.array([float(get_parameter(interior, name)) for name in names])
    slopes = np.asarray(call_compiled(_slopes, interior, names, values, centred.T))
    one, none = np.ones(grid.shape[1]), np.zeros(grid.shape[1])
    # A scale and two shifts: what distortion adds to them is far less than themselves.
    found = {"c_mm": centred / float(interior.c), "xp_mm": np.stack([one, none]), "yp_mm": np.stack([none, one])}
    found = {name: slopes[..., k].T for k, name in enumerate(names)} | found
    usual = {name: np.stack(field(*centred)) for name, field in _USUAL.items() if name.split()[0] not in names}
    return [(name, field) for name, field in (found | usual).items() if np.isfinite(field).all()]


@eqx.filter_jit
def _slopes(interior: InteriorOrientation, names: tuple[str, ...], values: Array, xy: Array) -> Array:
    """Of the measured or the ideal coordinate, whichever the model gives in closed form, by each parameter."""

    def of(v: Array, one: Array) -> Array:
        own = interior
        for name, value in zip(names, v, strict=True):
            own = set_parameter(own, name, value)
        return own.closed_form(one)

    return jax.vmap(jax.jacfwd(of), in_axes=(None, 0))(values, xy)


def _is_affine(field: Float[np.ndarray, "2 n"], centred: Float[np.ndarray, "2 n"]) -> bool:
    """Whether it stretches or shears the image, as rows do that are exposed one after another."""
    matrix = field @ np.linalg.pinv(centred)
    stretched = np.abs(matrix - np.eye(2) * np.trace(matrix) / 2).max() > _EXACT * np.abs(matrix).max()
    return bool(stretched and np.abs(matrix @ centred - field).max() < _EXACT * np.abs(field).max())


def _cure(adjusted: Adjustment, camera: str, name: str) -> str:
    interior = adjusted.unknowns.interior[camera]
    if name not in parameter_names(interior):
        return f"which the distortion {interior.distortion.name} has not: choose one that has it"
    return "which is held: free it" if f"interior[{camera}].{name}" not in adjusted.structure.labels else ""


LEAST_SEEN = 1e-3
"""Of an error in one observation, what estimated parameters must leave of it."""
SURE = 3.3
"""Standard deviations of itself beyond which the amount of a term is told: by chance one of a thousand."""
# Of many blunders the worst: more of them are a sign of the pattern itself.
_BLUNDERS = 16
# A blunder is what a term makes where it is off from that by less than this part.
_LIKE = 0.5


@shown
class Hint(NamedTuple):
    """One term that a pattern may be, and what it alone would be."""

    term: PatternTerm
    share: float
    """Of the whole pattern's square sum, 0 to 1."""
    amount: float
    sigma: float
    """A posteriori; both in the unit of the term."""
    moves: dict[str, float]
    """By how many of their standard deviations interior parameters would move with it, by path."""


@shown
class Trend(NamedTuple):
    """The test of one pattern."""

    pattern: ResidualPattern
    """Without its columns, which of a large block are hundreds of MB; `patterns_of` makes them again."""
    sigma: float
    """The median standard deviation of its observations."""
    freedom: int
    p_value: float
    size: float
    """Root mean square of what the pattern explains, its noise taken off, in the unit of the observations."""
    hints: tuple[Hint, ...]
    """The terms that a sentence can name, the one of the largest share first."""
    blunders_alike: int = 0
    """Of the blunders that are unknowns beside it, how many are what the first of these makes of their observations."""

    @property
    def alike(self) -> list[Hint]:
        """Of a pattern that is what all rows of a group are off by alike, the axes of which this is sure."""
        return [h for h in self.hints if abs(h.amount) > SURE * h.sigma] if self.pattern.group else []


def trends(
    adjusted: Adjustment, shared_sigma: Float[np.ndarray, "shared"], blunders: Sequence[tuple[str, int]] = ()
) -> list[Trend]:
    """All patterns that the observations of `adjusted` can show; those beyond chance have a small `p_value`.

    `shared_sigma` are the a posteriori standard deviations of the shared unknowns. Of `blunders`, rows by the name of
    their group and their number, the first are left out: their errors are unknowns beside the pattern.
    """
    if adjusted.redundancy < 2 or not bool(adjusted.converged):
        return []
    responses = Responses.of(adjusted)
    v = responses.residuals
    rows = [np.ravel(responses.places[name][..., row]) for name, row in blunders[:_BLUNDERS]]
    directions = _Directions(
        np.concatenate([np.zeros(0, int), *rows]), tuple(patterns_of(adjusted, responses.places)), responses.count
    )
    taken_up, moved = responses.products(directions.column, directions.ends[-1])
    moved = moved / np.where(shared_sigma > 0, shared_sigma, np.inf)
    out = _LeftOut.of(directions.at, v, taken_up, moved)
    found = (_tested(adjusted, directions, k, v, out, taken_up, moved) for k in range(len(directions.patterns)))
    return [trend for trend in found if trend is not None]


class _Directions(NamedTuple):
    """All that is solved for at once: an error in each of some observations, then the columns of each pattern."""

    at: Int[np.ndarray, "m"]
    patterns: tuple[ResidualPattern, ...]
    n_observations: int

    @property
    def ends(self) -> list[int]:
        """Behind the observations, and behind each pattern."""
        return np.cumsum([len(self.at), *(p.many for p in self.patterns)]).tolist()

    def column(self, k: int) -> Float[np.ndarray, "n"]:
        """Direction `k`, whitened."""
        own = bisect.bisect_right(self.ends, k)
        if own == 0:
            return self.unit(k)
        return self.patterns[own - 1].column(k - self.ends[own - 1], self.n_observations)

    def unit(self, k: int) -> Float[np.ndarray, "n"]:
        """An error of one in observation `at[k]`."""
        return np.bincount(self.at[k : k + 1], minlength=self.n_observations).astype(float)


class _LeftOut(NamedTuple):
    """Observations whose errors are unknowns beside all others."""

    errors: Float[np.ndarray, "m"]
    """Estimated, whitened."""
    moved: Float[np.ndarray, "m shared"]
    inverse: Float[np.ndarray, "m m"]
    explained: float
    freedom: int

    @classmethod
    def of(
        cls,
        at: Int[np.ndarray, "m"],
        v: Float[np.ndarray, "n"],
        taken_up: Float[np.ndarray, "k k"],
        moved: Float[np.ndarray, "k shared"],
    ) -> "_LeftOut":
        """Those at some places, the first directions."""
        m = len(at)
        inverse, freedom = inverse_of_seen(np.eye(m) - taken_up[:m, :m], np.eye(m), LEAST_SEEN)
        errors = inverse @ v[at]
        return cls(errors, moved[:m], inverse, float(v[at] @ errors), freedom)


def _tested(
    adjusted: Adjustment,
    directions: _Directions,
    k: int,
    v: Float[np.ndarray, "n"],
    out: _LeftOut,
    taken_up: Float[np.ndarray, "k k"],
    moved: Float[np.ndarray, "k shared"],
) -> Trend | None:
    pattern, (first, last), m = directions.patterns[k], directions.ends[k : k + 2], len(directions.at)
    own = pattern.products(whitened=True)
    of_units = [pattern.times(directions.unit(i)) for i in range(m)]
    beside = np.reshape(of_units, (m, pattern.many)).T - taken_up[first:last, :m]
    u = pattern.times(v) - beside @ out.errors
    c = own - taken_up[first:last, first:last] - beside @ out.inverse @ beside.T
    moved = moved[first:last] - beside @ out.inverse @ out.moved
    inverse, freedom = inverse_of_seen(c, own, pattern.least_seen)
    whole, redundancy = float(v @ v) - out.explained, adjusted.redundancy - out.freedom
    if freedom == 0 or redundancy <= freedom or whole <= 0:
        return None
    explained, b, sigma0 = float(u @ inverse @ u), inverse @ u, (whole / redundancy) ** 0.5
    square = pattern.products(whitened=False)
    size2 = (b @ square @ b - sigma0**2 * np.sum(square * inverse)) / pattern.rows
    hints = [h._replace(share=h.share / explained) for h in _hints(adjusted, pattern, u, c, own, moved, sigma0)]
    p = beta_tail(explained / whole, freedom / 2, (redundancy - freedom) / 2)
    hints.sort(key=lambda h: -h.share)
    alike = 0
    if hints and m:
        makes = hints[0].amount * (np.array(of_units) @ hints[0].term.coefficients)
        alike = int((np.abs(out.errors - makes) < _LIKE * np.abs(makes)).sum())
    told = pattern._replace(parts=())
    return Trend(told, pattern.sigma, freedom, p, max(float(size2), 0.0) ** 0.5, tuple(hints), alike)


def _hints(
    adjusted: Adjustment,
    pattern: ResidualPattern,
    u: Float[np.ndarray, "k"],
    c: Float[np.ndarray, "k k"],
    own: Float[np.ndarray, "k k"],
    moved: Float[np.ndarray, "k shared"],
    sigma0: float,
) -> list[Hint]:
    """Each term alone; its share is still its square sum. Terms that estimated parameters take up are left out."""
    found = []
    paths = [(k, label) for k, label in enumerate(adjusted.structure.labels) if label.startswith("interior[")]
    for term in pattern.terms:
        a = term.coefficients
        precision, whole = float(a @ c @ a), float(a @ own @ a)
        if precision <= pattern.least_seen * whole:
            continue
        amount = float(a @ u) / precision
        moves = {label: float(amount * (a @ moved[:, k])) for k, label in paths}
        found.append(Hint(term, float(a @ u) ** 2 / precision, amount, sigma0 / precision**0.5, moves))
    return found


def inverse_of_seen(
    c: Float[np.ndarray, "k k"], own: Float[np.ndarray, "k k"], least: float
) -> tuple[Float[np.ndarray, "k k"], int]:
    """The inverse of `c` over the directions that show, and how many they are; `own` is `c` without any unknowns."""
    if not np.isfinite(c).all():
        # Numbers that overflow: of what fits nothing, no direction shows.
        return np.zeros_like(c), 0
    size = np.sqrt(np.diagonal(own))
    unit = np.where(size > 0, 1 / np.where(size > 0, size, 1.0), 0.0)
    values, vectors = np.linalg.eigh(c * unit[:, None] * unit)
    kept = values > least
    half = vectors[:, kept] / np.sqrt(values[kept]) * unit[:, None]
    return half @ half.T, int(kept.sum())
