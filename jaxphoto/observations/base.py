"""Base class of observations: rows, what one row touches, and the residual of one row.

A file that adds an observation defines one final subclass of `AbstractObservations`. Derivatives, elimination, padding,
redundancy numbers, noise, sensitivities, datum, tables and files follow from its declarations.

    class HeightDifferences(AbstractObservations):
        group = "height_differences"
        unit = "m"
        start: Int[np.ndarray, "n"] = index_of("point")
        end: Int[np.ndarray, "n"] = index_of("point")
        value: Float[ArrayLike, "n"]
        sigma: Float[ArrayLike, "n"]

        def residual(self, start, end):
            return self.value - (end[2] - start[2])

Its file is height_differences.csv with the columns start, end, value_m and sigma_m (`observations.columns`).

Inside `residual` the module is *one* row: `self.value` is a number. Its arguments are what the fields marked `index_of`
refer to, in order (a field of several indices per row gives a stack with a leading axis), then the kinds in
`block_parameters`. A point is its three coordinates (m), an image an `ImageState`; any kind of declared unknowns
(`jaxphoto.parameters`) gives parameters of that kind.
"""

import abc
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar, Self, dataclass_transform

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxphoto.arrays import ArrayLike, from_list, joined, to_numpy
from jaxphoto.georeferencing import Exposure, Mount, StripBias
from jaxphoto.observations.columns import row_fields, whole_fields
from jaxphoto.short_repr import pretty_repr
from jaxphoto.static_values import StaticArray, map_arrays

AXES = ("X", "Y", "Z")


def index_of(what: str) -> Any:
    """Declare a field of indices: of "image", "point", or a kind of declared unknowns such as "strips"."""
    return eqx.field(metadata={"touches": what})


class ImageState(eqx.Module):
    """State of one image while its rows are evaluated."""

    position: Float[Array, "3"]
    """Projection centre (m)."""
    camera_from_object: Float[Array, "3 3"]
    exposure: Exposure
    parameters: dict[str, Any]
    """Declared unknowns of the image, by kind; zeros if the image has none of a kind that others have."""
    interior: Any = None
    """Interior orientation, for rows whose class sets `uses_interior`."""

    @property
    def mount(self) -> Mount:
        """Lever arm, boresight and time offset of its camera."""
        return self.parameters.get("mounts") or Mount(jnp.zeros(3), jnp.zeros(3))

    @property
    def strip(self) -> StripBias:
        """Shift and drift of its strip."""
        return self.parameters.get("strips") or StripBias(jnp.zeros(3), jnp.zeros(3))


@pretty_repr
@dataclass_transform(field_specifiers=(index_of, eqx.field))
class AbstractObservations(eqx.Module):
    """Rows of one kind, along the first axis of every field; requires `sigma`, in the unit of the residual."""

    group: eqx.AbstractClassVar[str]
    """Name of the group in tables, files and results."""
    unit: eqx.AbstractClassVar[str]
    """m, mm, rad, s ...; tables show rad in degrees."""
    axes: ClassVar[tuple[str, ...]] = ("",)
    """Names of the numbers of a row."""
    block_parameters: ClassVar[tuple[str, ...]] = ()
    """Kinds of unknowns of the whole block that a row touches in addition; None if the block has none."""
    observed: ClassVar[str] = "value"
    """Observed field: noise is added to it, and derivatives are taken by it."""
    rigid_invariant: ClassVar[bool] = False
    """True if the residuals are invariant under rigid-body motion."""
    uses_interior: ClassVar[bool] = False
    """True if a row touches the interior orientation of its image."""
    columns: ClassVar[Mapping[str, str | tuple[str, ...]]] = MappingProxyType({})
    """Column names in files, by field, that differ from those of `observations.columns`."""
    unique: ClassVar[bool] = False
    """True if files may list what a row touches, in any order, only once."""

    def __getattribute__(self, name: str) -> Any:
        value = object.__getattribute__(self, name)
        return value.plain if isinstance(value, StaticArray) else value

    def __check_init__(self) -> None:
        # Indices are structure; only numbers are leaves.
        whole = whole_fields(type(self))
        for name, value in vars(self).items():
            if name in whole and not isinstance(value, jax.core.Tracer):
                object.__setattr__(self, name, StaticArray(value))
            else:
                object.__setattr__(self, name, from_list(value))

    @abc.abstractmethod
    def residual(self, *touched: Any) -> Float[ArrayLike, "..."]:
        """Return observed minus computed of one row, in the unit."""

    def whitened(self, residual: Float[ArrayLike, "..."]) -> Float[ArrayLike, "..."]:
        """Return the residual of one row over its standard deviation."""
        return residual / self.sigma  # type: ignore[attr-defined]

    def with_sigmas_times(self, factor: Float[ArrayLike, "..."]) -> Self:
        """Scale the standard deviations by `factor`, by number: (n,) or (n, axes)."""
        return eqx.tree_at(lambda rows: rows.sigma, self, self.sigmas * factor)

    def without_weight(self) -> Self:
        """Return rows of zero weight, used as padding."""
        return eqx.tree_at(lambda rows: rows.sigma, self, np.full(np.shape(self.sigmas), np.inf))

    def indices(self) -> list[tuple[str, Int[ArrayLike, "..."]]]:
        """Return kinds and indices of what the rows refer to: (n,), or more axes if a row touches several."""
        return [
            (f.metadata["touches"], getattr(self, f.name)) for f in dataclasses.fields(self) if "touches" in f.metadata
        ]

    @property
    def observation(self) -> ArrayLike:
        """Return the observed numbers: (n,), or (n, axes)."""
        return getattr(self, self.observed)

    def with_observation(self, value: ArrayLike) -> Self:
        """Replace the observed numbers."""
        return eqx.tree_at(lambda rows: getattr(rows, self.observed), self, value)

    def physical(self, whitened: Float[ArrayLike, "..."]) -> Float[np.ndarray, "..."]:
        """Convert residuals over their standard deviations, (n,) or (axes, n), to the unit."""
        return np.asarray(whitened) * np.asarray(self.sigmas).T

    @classmethod
    def none(cls) -> Self:
        """Return no rows."""
        return cls(**{f.name: np.zeros((0, *f.shape), int if f.whole else float) for f in row_fields(cls)})

    def validation_errors(self) -> Iterator[tuple[int, str]]:
        """Yield (row, message) for every invalid row."""
        return iter(())

    @property
    def sigmas(self) -> Any:
        """Return standard deviations of the observed numbers (n,) or (n, axes)."""
        return self.sigma  # type: ignore[attr-defined]

    def __len__(self) -> int:
        return len(getattr(self, dataclasses.fields(self)[0].name))

    @classmethod
    def joined(cls, *parts: Self) -> Self:
        """Concatenate the rows of all `parts`."""
        return cls(**{f.name: joined([getattr(p, f.name) for p in parts]) for f in dataclasses.fields(cls)})

    def take(self, chosen: np.ndarray) -> Self:
        """Select rows by index or mask."""
        return map_arrays(lambda v: to_numpy(v)[chosen], self)

    def renumbered(self, **new: np.ndarray) -> Self:
        """Keep rows whose images and points remain: `new` gives, by kind, the new index of each or -1."""
        touched = {f.name: f.metadata["touches"] for f in dataclasses.fields(self) if "touches" in f.metadata}
        fields = {name: new[what] for name, what in touched.items() if what in new}
        kept = np.ones(len(self), bool)
        for name, number in fields.items():
            kept &= (number[getattr(self, name)] >= 0).all(axis=tuple(range(1, np.ndim(getattr(self, name)))))
        some = self.take(np.flatnonzero(kept))
        return dataclasses.replace(some, **{name: number[getattr(some, name)] for name, number in fields.items()})

    def axis_names(self) -> np.ndarray:
        """Return the axis name of each observed number: (n,), or (axes, 1) if a row has several."""
        return np.array(self.axes)[:, None] if len(self.axes) > 1 else np.full(len(self), self.axes[0], object)

    @property
    def axis_of_numbers(self) -> np.ndarray:
        """Return the axis name of each observed number, (axes, n)."""
        return np.atleast_2d(np.broadcast_to(self.axis_names(), np.shape(self.observation)[::-1]))

    def names_of(self, what: str, names: Sequence[str] | np.ndarray) -> np.ndarray:
        """Return the hyphenated names of the images or points of each row (n,), or number (axes, n)."""
        table, parts = np.array([*names, ""], object), []
        for touched, index in self.indices():
            if touched == what:
                parts += [table[np.asarray(index, int)[(slice(None), *at)]] for at in np.ndindex(*np.shape(index)[1:])]
        return np.array(["-".join(of) for of in zip(*parts, strict=True)] if parts else [""] * len(self), object)

    def words(self, images: Sequence[str], points: Sequence[str]) -> np.ndarray:
        """Return labels of the observed numbers, shaped like the residuals: "station of image 12 in Z"."""
        whose = [
            " ".join(part for part in ("image " + i if i else "", "point " + p if p else "") if part)
            for i, p in zip(self.names_of("image", images), self.names_of("point", points), strict=True)
        ]
        thing = self.group.replace("_", " ").removesuffix("s")
        axis = self.axis_names()
        shape = np.broadcast_shapes(axis.shape, (len(self),))
        both = zip(*(v.ravel() for v in np.broadcast_arrays(np.array(whose, object), axis)), strict=True)
        return np.array([f"{thing} of {who}" + (f" in {a}" if a else "") for who, a in both], object).reshape(shape)

    def words_of(
        self,
        numbers: Int[np.ndarray, " some"],
        rows: Int[np.ndarray, " some"],
        images: Sequence[str],
        points: Sequence[str],
    ) -> list[str]:
        """Return labels of one number in each of `rows`: all labels of millions take hundreds of MB."""
        numbered = not any(what in ("image", "point") for what, _ in self.indices())
        # Labels of rows without images and points may contain their index among all.
        some, at = (self, rows) if numbered else (self.take(rows), np.arange(len(rows)))
        words = np.broadcast_to(some.words(images, points), (len(self.axes), len(some)))
        return [str(word) for word in words[numbers, at]]


class AbstractCoordinates(AbstractObservations):
    """Single coordinates (m): `who` (index of a point or an image), `axis` (0, 1, 2), `value` and `sigma`."""

    who: eqx.AbstractVar[np.ndarray]
    axis: eqx.AbstractVar[np.ndarray]
    value: eqx.AbstractVar[ArrayLike]
    sigma: eqx.AbstractVar[ArrayLike]

    def axis_names(self) -> np.ndarray:
        """Return X, Y or Z of each row."""
        return np.array(AXES, object)[self.axis]
