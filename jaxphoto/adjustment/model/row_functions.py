"""Residuals of observation groups and their derivatives with respect to the unknowns that each row involves.

A row is a function of few variables: the increments z of its images (6 each), its shared unknowns and its points (3
each). All rows of a group are evaluated together and differentiated automatically; no dense Jacobian is formed. Rows
are the last axis; for rows stored by point, rows and points are the last two.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, Shaped

from jaxphoto.adjustment.model.camera_groups import interior_of
from jaxphoto.adjustment.model.numbers import AbstractValues, Increments, NonImageResiduals, datum_residuals
from jaxphoto.adjustment.model.observed_groups import ObservedGroup, RowsAtPoints, image_tables
from jaxphoto.adjustment.model.structure import AbstractStructure
from jaxphoto.georeferencing import Exposure
from jaxphoto.observations import AbstractObservations, ImageState
from jaxphoto.parameters import filled
from jaxphoto.rotation import small_rotation


class RowVariables(NamedTuple):
    """Increments of the unknowns that one row involves, or derivatives with respect to them."""

    eop: Float[Array, "k 6"]
    shared: Float[Array, "l"]
    points: Float[Array, "j 3"]


class RowInputs(NamedTuple):
    """Other inputs of a row; for many rows, rows last."""

    row: AbstractObservations
    scale: RowVariables
    position: Float[Array, "k 3"]
    rotation: Float[Array, "k 3 3"]
    exposure: tuple[Array, ...]
    """Fields of an `Exposure`, with a leading axis over the k images."""
    parameters: Float[Array, "p"]
    points: Float[Array, "j 3"]


# Maximum number of array elements in memory at a time: 100,000 rows with fifty unknowns each would exceed the memory.
_AT_ONCE = 1 << 24
# Minimum number of derivatives for which reverse mode is faster (forty times for 365 knots).
_MANY_SLOPES = 16
# Mapped axes: over points and over rows, for rows stored by point.
_OVER_POINTS = RowVariables(None, -1, -1), RowInputs(-1, RowVariables(None, -1, -1), None, None, None, -1, -1)  # type: ignore[arg-type]
_OVER_ROWS = RowVariables(None, -1, None), RowInputs(-1, RowVariables(None, -1, None), None, None, None, -1, None)  # type: ignore[arg-type]


def each_row(
    function: Callable[[RowVariables, RowInputs], Any], group: ObservedGroup, z: RowVariables, given: RowInputs
) -> Any:
    """Map `function` over rows (last axis)."""
    if isinstance(group.rows, RowsAtPoints):
        return jax.vmap(jax.vmap(function, _OVER_ROWS, -1), _OVER_POINTS, -1)(z, given)
    return jax.vmap(function, -1, -1)(z, given)


def rows_of(group: ObservedGroup, numbers: Any) -> AbstractObservations:
    """Combine indices and values of rows."""
    own = numbers.at_points if isinstance(numbers, RowsAtPoints) else numbers.listed
    return eqx.combine(group.own, own)


def gathered_rows(
    group: ObservedGroup, numbers: Any, y: Increments, scale: Increments, v: AbstractValues
) -> tuple[RowVariables, RowInputs]:
    """Gather the unknowns of every row of a group at the increments `y`."""
    at_points = isinstance(group.rows, RowsAtPoints)

    def of_images(a: Array) -> Array:
        if at_points:
            return jnp.zeros((0, *jnp.shape(a)[:-1]))
        return jnp.moveaxis(jnp.asarray(a)[..., group.image], -2, 0)

    def of_points(a: Array) -> Array:
        return a[None] if at_points else jnp.moveaxis(jnp.asarray(a)[..., group.point], -2, 0)

    def of_shared(a: Array, index: Any) -> Array:
        return jnp.append(a, 0.0)[index]

    # A scale of zero marks a fixed exterior orientation.
    z = RowVariables(of_images(y.eop), of_shared(y.shared, group.column), of_points(y.points))
    steps = RowVariables(of_images(scale.eop), of_shared(scale.shared, group.column), of_points(scale.points))
    exposure = tuple(map(of_images, v.exposures))
    parameters = of_shared(v.shared, group.parameter)
    row = rows_of(group, numbers)
    return z, RowInputs(
        row, steps, of_images(v.position), of_images(v.rotation), exposure, parameters, of_points(v.points)
    )


def row_function(group: ObservedGroup, s: AbstractStructure) -> Callable[[RowVariables, RowInputs], Float[Array, "c"]]:
    """Return the function that evaluates observed minus computed, over sigma, of one row."""
    tables = image_tables(s.tables)
    forms = {t.kind: (t.form, t.size) for t in s.tables}

    def residual(z: RowVariables, given: RowInputs) -> Float[Array, "c"]:
        parameters = given.parameters
        if group.place:
            # Add to all parameters in one operation: separate updates would copy the array each time.
            parameters = parameters.at[jnp.array(group.place)].add(z.shared * given.scale.shared)
        position = given.position + z.eop[:, :3] * given.scale.eop[:, :3]
        points = given.points + z.points * given.scale.points
        first = image = point = 0
        touched: list[Any] = []

        def take(size: int) -> Array:
            nonlocal first
            first += size
            return parameters[first - size : first]

        def state(k: int) -> ImageState:
            turn = small_rotation(z.eop[k, 3:] * given.scale.eop[k, 3:])
            own = {t.kind: filled(t.form, take(t.size)) for t in tables}
            camera = None
            if group.uses_interior:
                (only,) = s.groups
                camera = interior_of(only, list(take(only.treedef.num_leaves)))
            exposure = Exposure(*(a[k] for a in given.exposure))
            return ImageState(position[k], turn @ given.rotation[k], exposure, own, camera)

        # Image parameters come first, in the order of `observed_groups.group_of`.
        states = [state(k) for k in range(len(group.image))]
        for what, shape in group.arguments:
            count = math.prod(shape)
            if what == "image":
                own, image = states[image : image + count], image + count
                touched.append(_stacked(own, shape))
            elif what == "point":
                touched.append(points[point : point + count].reshape(*shape, 3))
                point += count
            elif what == "parameter":
                touched.append(take(count).reshape(shape))
            elif what in forms:
                form, size = forms[what]
                numbers = take(count * size).reshape(*shape, size)
                each = lambda v, form=form: filled(form, v)  # noqa: E731
                for _ in shape:
                    each = jax.vmap(each)
                touched.append(each(numbers))
            else:
                touched.append(None)
        v = jnp.ravel(given.row.whitened(given.row.residual(*touched)))
        return v if group.loss is None else jnp.stack(group.loss.reduced(*v))

    return residual


def _stacked(parts: list[Any], shape: tuple[int, ...]) -> Any:
    """Return the first of `parts`, or all of them stacked with leading axes `shape`."""
    if not shape:
        return parts[0]
    return jax.tree.map(lambda *v: jnp.stack(v).reshape(*shape, *jnp.shape(v[0])), *parts)


class RowJacobian(NamedTuple):
    """Residuals of a group and their derivatives with respect to scaled increments, rows last."""

    residual: Float[Array, "c *rows"]
    eop: Float[Array, "c k 6 *rows"]
    shared: Float[Array, "c l *rows"]
    points: Float[Array, "c j 3 *rows"]


def group_residuals(
    group: ObservedGroup, numbers: Any, y: Increments, scale: Increments, v: AbstractValues, s: AbstractStructure
) -> Float[Array, "c *rows"]:
    """Evaluate the residuals of a group over their sigmas."""
    return each_row(row_function(group, s), group, *gathered_rows(group, numbers, y, scale, v))


def row_jacobian(
    group: ObservedGroup, numbers: Any, y: Increments, scale: Increments, v: AbstractValues, s: AbstractStructure
) -> RowJacobian:
    """Evaluate the residuals of a group and the derivatives of each row."""
    function = row_function(group, s)

    def ahead(z: RowVariables, given: RowInputs) -> tuple[Float[Array, "c"], RowVariables]:
        # Residuals are computed together with the derivatives.
        slopes, residual = jax.jacfwd(lambda z: (function(z, given),) * 2, has_aux=True)(z)
        return residual, slopes

    def back(z: RowVariables, given: RowInputs) -> tuple[Float[Array, "c"], RowVariables]:
        residual, jt_product = jax.vjp(lambda z: function(z, given), z)
        (slopes,) = jax.vmap(jt_product)(jnp.eye(len(residual)))
        return residual, slopes

    touched, given = gathered_rows(group, numbers, y, scale, v)
    slopes = (6 * len(group.image) + len(group.place) + 3 * len(group.point)) // group.components
    one, copies = (ahead, slopes) if slopes < _MANY_SLOPES else (back, 1)
    # One copy of the parameters per row.
    size = rows_at_once(group.components * copies * len(group.parameter))
    size = group.n_rows if isinstance(group.rows, RowsAtPoints) else size
    residual, slope = over_portions(lambda *own: each_row(one, group, *own), (touched, given), group.n_rows, size)
    return RowJacobian(residual, slope.eop, slope.shared, slope.points)


def rows_at_once(numbers: int) -> int:
    """Return the number of rows of `numbers` elements each that fit in memory."""
    return max(1, _AT_ONCE // max(numbers, 1))


def over_portions(function: Callable[..., Any], values: tuple[Any, ...], n_rows: int, size: int) -> Any:
    """Apply `function` to `values`, whose rows run along their last axes, `size` rows at a time."""
    if n_rows <= size:
        return function(*values)
    portions = jax.tree.map(lambda v: in_portions(v, size), values)
    found = jax.lax.map(lambda own: function(*own), portions)
    return jax.tree.map(lambda v: _together(v)[..., :n_rows], found)


def in_portions(values: Shaped[Array, "*k rows"], size: int) -> Shaped[Array, "portions *k size"]:
    """Split into portions of `size` rows; the last row is repeated to fill the last portion."""
    *k, n = values.shape
    filled = jnp.pad(values, [(0, 0)] * len(k) + [(0, -n % size)], "edge")
    return jnp.moveaxis(filled.reshape(*k, -(-n // size), size), -2, 0)


def _together(portions: Shaped[Array, "portions *k size"]) -> Shaped[Array, "*k rows"]:
    number, *k, size = portions.shape
    return jnp.moveaxis(portions, 0, -2).reshape(*k, number * size)


def reduced_places(g: ObservedGroup, n_images: int) -> Int[Array, "z rows"]:
    """Return the indices of the image unknowns and shared unknowns of a group's rows among the reduced unknowns.

    Entries without an unknown get an index beyond the last.
    """
    images = 6 * jnp.asarray(g.image)[:, None] + jnp.arange(6)[:, None]
    return jnp.concatenate([images.reshape(-1, images.shape[-1]), 6 * n_images + jnp.asarray(g.column)])


def non_image_residuals(
    increments: Increments, scale: Increments, values: AbstractValues, structure: AbstractStructure
) -> NonImageResiduals:
    """Evaluate all residuals except image rows."""
    others = tuple(
        group_residuals(g, numbers, increments, scale, values, structure)
        for g, numbers in zip(structure.observed, values.groups, strict=True)
    )
    datum = datum_residuals(increments, scale, values, structure)
    return NonImageResiduals(others, datum, tuple(g.name for g in structure.observed))
