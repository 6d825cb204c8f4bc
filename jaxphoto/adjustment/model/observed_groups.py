"""Groups of observations except image points: index arrays of the unknowns that each row involves, built once on the
host.

The unknowns that rows of a group involve determine how they enter the normal equations:

    reduced     no point: rows add to the reduced normal matrix of images and shared unknowns
    point       one point and no image: rows add to the block of the point before it is eliminated, and involve few
                shared unknowns (`layout.padded.RayLists.met`)
    coupled     all others, such as two points, or a point and an image: few rows, represented by extra unknowns
                (`solver.normal`)
"""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Int

from jaxphoto.adjustment.model.parameter_tables import JointPrior, ParameterTable
from jaxphoto.arrays import namespace, vector_of
from jaxphoto.block import Block, named_rows
from jaxphoto.errors import BlockError
from jaxphoto.losses import AbstractLoss, LinearisedLoss
from jaxphoto.observations import (
    PRIORS,
    AbstractObservations,
    KnownParameters,
    ParameterRows,
    PointRows,
    PositionRows,
    RotationRows,
    correlated,
)
from jaxphoto.static_values import with_plain_arrays
from jaxphoto.unknowns import Unknowns, Weighted, check_prior

RowElimination = Literal["reduced", "point", "coupled"]


class Argument(NamedTuple):
    """Argument of the residual function of a row."""

    what: str
    """"image", "point", "parameter", or a kind of declared parameters."""
    shape: tuple[int, ...]
    """() for one object, (m,) for a stack of m."""


class RowsInList(NamedTuple):
    """Rows along the last axis."""

    listed: AbstractObservations


class RowsAtPoints(NamedTuple):
    """Rows stored by point: arrays end in (rows, points), where rows is the largest number of rows at a point."""

    at_points: AbstractObservations


class ObservedGroup(eqx.Module):
    """Group of observations: index arrays of its rows and of the objects they involve, rows last."""

    name: str = eqx.field(static=True)
    elimination: RowElimination = eqx.field(static=True)
    scalar: bool = eqx.field(static=True)
    """True if a row is a scalar; its residuals in results then have no component axis."""
    components: int = eqx.field(static=True)
    arguments: tuple[Argument, ...] = eqx.field(static=True)
    uses_interior: bool = eqx.field(static=True)
    rigid_invariant: bool = eqx.field(static=True)
    rows: RowsInList | RowsAtPoints
    """Indices only; the observed values are in `Values.groups`."""
    image: Int[np.ndarray, "k rows"]
    """Images that a row involves."""
    point: Int[np.ndarray, "j rows"]
    parameter: Int[np.ndarray, "p *_"]
    """Indices of the parameters that a row involves in the vector of shared parameters; its length if there is none.
    The parameters of each image come first, table by table, then the parameters of the other arguments. (p, rows), or
    by point (p, rows, points).
    """
    place: tuple[int, ...] = eqx.field(static=True)
    """Indices of the parameters that are unknown in at least one row."""
    column: Int[np.ndarray, "l *_"]
    """Shared unknown of each of these; the number of shared unknowns if a row has none."""
    slot: Int[np.ndarray, "l _ _"]
    """For rows stored by point: slot of the shared unknown in the list of the point's group, see `RayLists.met`;
    otherwise empty.
    """
    loss: AbstractLoss | LinearisedLoss | None
    """Loss of a row if it is not quadratic."""
    pair: Int[np.ndarray, "pairs rows 4"]
    """In a padded structure: position of each pair of images of a row in the band (`RayLists.block`), and 1 if
    transposed.
    """

    @property
    def own(self) -> AbstractObservations:
        """Index arrays of the rows."""
        return self.rows.at_points if isinstance(self.rows, RowsAtPoints) else self.rows.listed

    @property
    def depth(self) -> int:
        """Largest number of rows at a point."""
        return int(np.bincount(self.point[0]).max(initial=0))

    @property
    def n_rows(self) -> int:
        """Number of rows, including empty slots of rows stored by point."""
        return int(np.shape(jax.tree.leaves(self.own)[0])[-1])


def observations_of(
    block: Block, priors: Unknowns, together: Sequence[JointPrior], labels: Sequence[str]
) -> list[tuple[str, AbstractObservations]]:
    """Return all non-empty groups of a block with their names: observations first, then prior information.

    Scalar priors of shared parameters are not included (`weighted_parameters`). Raises BlockError for rows that refer
    to missing objects.
    """
    named = list(named_rows([*block.observations, *_priors_of_places(block, priors)]).items())
    for _, rows in named:
        _check(rows, block)
    known = [k for k in block.more if isinstance(k, KnownParameters)]
    place = {label: k for k, label in enumerate(labels)}
    for k in known:
        if missing := [label for label in k.labels if label not in place]:
            raise BlockError(f"unknown parameter {missing[0]}; the block has {', '.join(list(place)[:4])} ...")
    sets = [JointPrior(np.array([place[x] for x in k.labels]), k.value, k.covariance) for k in known]
    for n, (parameters, value, covariance) in enumerate([*together, *sets]):
        size = len(parameters)
        rows = ParameterRows(parameters, _spread(value, (size,)), np.ones(size))
        covariance = _spread(covariance, (size, size))
        named.append((f"{PRIORS}_together" + f"#{n + 1}" * (n > 0), correlated(rows, [range(size)], covariance[None])))
    return named


def weighted_parameters(priors: Sequence[object], together: Sequence[JointPrior]) -> ParameterRows:
    """Return the scalar priors of shared parameters, in parameter order."""
    joint = {int(k) for t in together for k in t.parameters}
    own = {k: prior for k, prior in enumerate(priors) if isinstance(prior, Weighted) and k not in joint}
    value = vector_of([prior.value for prior in own.values()])
    sigma = vector_of([prior.sigma for prior in own.values()])
    return ParameterRows(np.array(list(own), int), value, sigma)


def _spread(v: Any, shape: tuple[int, ...]) -> Any:
    return namespace(v).broadcast_to(v, shape)


def _priors_of_places(block: Block, priors: Unknowns) -> list[AbstractObservations]:
    """Return weighted exterior orientations and points. Raises InputError for an invalid prior."""
    found: list[AbstractObservations] = []
    exterior, n, m = priors.exterior, len(block.images), len(block.points)
    for label, prior, kind, count, shape in (
        ("exterior.position", exterior.position, PositionRows, n, (3,)),
        ("exterior.camera_from_object", exterior.camera_from_object, RotationRows, n, (3, 3)),
        ("points", priors.points, PointRows, m, (3,)),
    ):
        check_prior(label, prior)
        if not isinstance(prior, Weighted):
            continue
        value, sigma = _spread(prior.value, (count, *shape)), _spread(prior.sigma, (count, 3))
        extra = (np.zeros((count, 3)),) if kind is RotationRows else ()
        rows = kind(np.arange(count), value, sigma, *extra)
        if prior.covariance is None:
            found.append(rows)
        else:
            found.append(correlated(rows, np.arange(count)[:, None], _spread(prior.covariance, (count, 3, 3))))
    return found


def _check(rows: AbstractObservations, block: Block) -> None:
    for what, index in rows.indices():
        size = {"image": len(block.images), "point": len(block.points)}.get(what)
        index = np.asarray(index)
        if index.dtype.kind not in "iu":
            raise BlockError(f"{rows.group}: indices of {what}s must be integers, got {index.dtype}")
        if size is None:
            continue
        bad = np.flatnonzero(((index < 0) | (index >= size)).reshape(len(index), -1).any(axis=1))
        if len(bad):
            raise BlockError(
                f"{rows.group}, row {bad[0]}: {what} {index[bad[0]]} is out of range, the block has {size}"
            )


def group_of(
    name: str,
    rows: AbstractObservations,
    tables: Sequence[ParameterTable],
    cameras: Int[np.ndarray, "p images"] | None,
    unknown_of: Int[np.ndarray, "parameters_and_none"],
    n_shared: int,
) -> ObservedGroup:
    """Build the index arrays of a group.

    `cameras` contains the indices of the interior orientation of each image, `unknown_of` the shared unknown of each
    parameter (`n_shared` for none).
    """
    if rows.uses_interior and any(t.modifies_interior for t in tables):
        names = ", ".join(t.kind for t in tables if t.modifies_interior)
        raise BlockError(
            f"{rows.group} with covariances need cameras without time-dependent interior orientation: remove {names}"
        )
    n, nowhere = len(rows), len(unknown_of) - 1
    by_kind = {t.kind: t for t in tables}
    images, points, of_images, of_others, arguments = [], [], [], [], []
    own = image_tables(tables)
    for what, index in rows.indices():
        argument = Argument(what, index.shape[1:])
        arguments.append(argument)
        for one in np.asarray(index, np.int32).reshape(n, -1).T:
            if what == "image":
                images.append(one)
                of_images += [t.numbers_at(t.of_image[one], nowhere) for t in own]
                if rows.uses_interior:
                    of_images.append(_cameras(rows, cameras)[:, one])
            elif what == "point":
                points.append(one)
            elif what == "parameter":
                of_others.append(one[None])
            elif what in by_kind:
                of_others.append(by_kind[what].numbers_at(one, nowhere))
            else:
                raise BlockError(f"{rows.group}: the rows refer to {what}, but the block has none")
    for kind in rows.block_parameters:
        arguments.append(Argument(kind, ()))
        if kind in by_kind:
            of_others.append(np.repeat(by_kind[kind].numbers_at(np.zeros(1, int), nowhere), n, axis=1))
    parameter = np.concatenate([np.zeros((0, n), np.int32), *of_images, *of_others]).astype(np.int32)
    column = unknown_of[parameter]
    place = np.flatnonzero((column < n_shared).any(axis=1))
    column = column[place].astype(np.int32)
    elimination: RowElimination = "reduced" if not points else "point" if len(points) == 1 and not images else "coupled"
    return ObservedGroup(
        name=name,
        elimination=elimination,
        scalar=len(rows.axes) == 1,
        components=len(rows.axes),
        arguments=tuple(arguments),
        uses_interior=rows.uses_interior,
        rigid_invariant=rows.rigid_invariant or not (images or points),
        rows=RowsInList(indices_of(rows)),
        image=_stack(images, n),
        point=_stack(points, n),
        parameter=parameter,
        place=tuple(int(k) for k in place),
        column=column,
        slot=np.zeros((len(column), 0, 0), np.int32),
        loss=None,
        pair=np.zeros((0, n, 4), np.int32),
    )


def _cameras(rows: AbstractObservations, cameras: np.ndarray | None) -> np.ndarray:
    if cameras is None:
        raise BlockError(f"{rows.group} use the interior orientation: give all cameras one distortion model")
    return cameras


def _stack(parts: list[np.ndarray], n: int) -> np.ndarray:
    return np.stack(parts) if parts else np.zeros((0, n), np.int32)


def image_tables(tables: Sequence[ParameterTable]) -> list[ParameterTable]:
    """Return the tables that contain parameters of the images of a row."""
    return [t for t in tables if t.of_images and not t.modifies_interior]


def indices_of(rows: AbstractObservations) -> AbstractObservations:
    """Return the index arrays of rows, rows last."""
    whole = eqx.filter(with_plain_arrays(rows), lambda v: not _is_number(v))
    return jax.tree.map(lambda v: np.moveaxis(np.asarray(v), 0, -1), whole)


def numbers_in(rows: AbstractObservations) -> AbstractObservations:
    """Return the numeric fields of the rows as float64, indices omitted, with the row axis last."""
    whole = eqx.filter(with_plain_arrays(rows), _is_number)

    def last(v: Any) -> Any:
        traced = isinstance(v, jax.core.Tracer)
        return jax.numpy.moveaxis(v, 0, -1) if traced else np.moveaxis(np.asarray(v, float), 0, -1)

    return jax.tree.map(last, whole)


def _is_number(v: Any) -> bool:
    return np.dtype(getattr(v, "dtype", float)).kind == "f"
