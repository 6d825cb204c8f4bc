"""Variants of a block for experiments: pure functions from block to block, composed by calling.

    vertical_control(strips(block, ["north", "south"]))

The modes of georeferencing of paper 004 are three of them (`MODES`): they differ in observations and fixed parameters,
not in the adjustment (docs/georeferencing.md).
"""

import dataclasses
from collections.abc import Callable, Collection, Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxphoto.arrays import is_traced, to_numpy
from jaxphoto.block import Block, Datum, direct_exterior, sensor_rows
from jaxphoto.camera import set_parameter
from jaxphoto.errors import BlockError, InputError, few
from jaxphoto.georeferencing import StripBias
from jaxphoto.observations import (
    AXES,
    AbstractObservations,
    Attitudes,
    CameraPositions,
    ControlCoordinates,
    Correlated,
    KnownParameters,
    RelativeAttitudes,
    RelativePositions,
)
from jaxphoto.parameters import AbstractParameters, dynamic_fields
from jaxphoto.unknowns import FIXED, FREE, late_cameras

# Kinds of observations of exposures by GNSS, and by an IMU.
_POSITIONS: tuple[type, ...] = (CameraPositions, RelativePositions)
_TURNS: tuple[type, ...] = (Attitudes, RelativeAttitudes)


def indirect(block: Block) -> Block:
    """Remove stations and attitudes: only control determines the position of the block."""
    return without_attitudes(without_stations(block))


def integrated(block: Block) -> Block:
    """Return the block unchanged: stations and attitudes are weighted observations in addition to the image points."""
    return block


def direct(block: Block) -> Block:
    """Compute the exterior orientation from stations, attitudes and mounts, and fix it.

    An image without full station and attitude retains its start value. Stations and attitudes are removed: the
    orientation is computed from them, and using them again as observations would create false redundancy. Raises
    BlockError for an image whose orientation is determined neither by sensors nor by start values.
    """
    rows = sensor_rows(block, block.start.unknowns)
    known = np.array(block.start.image_known, bool)
    known[rows.image] = True
    if not known.all():
        left = np.flatnonzero(~known)
        so = "1 such image" if len(left) == 1 else f"{len(left)} such images"
        raise BlockError(
            f"image {block.images[left[0]]} has neither station and attitude nor an exterior orientation ({so}), "
            "which direct georeferencing needs: give them, or choose another mode"
        )
    found = direct_exterior(rows)
    exterior = jax.tree.map(lambda old, new: jnp.asarray(old).at[rows.image].set(new), _exterior(block), found)
    start = eqx.tree_at(lambda s: (s.unknowns.exterior, s.image_known), block.start, (exterior, known))
    held = jax.tree.map(lambda _: FIXED, _exterior(block))
    return eqx.tree_at(lambda b: (b.start, b.priors.exterior), indirect(block), (start, held))


MODES: dict[str, Callable[[Block], Block]] = {"direct": direct, "integrated": integrated, "indirect": indirect}
"""Modes of georeferencing by name in block.toml."""


def without_stations(block: Block) -> Block:
    """Remove GNSS positions, also relative ones, and fix the parameters that only they determine: lever arms, shifts
    and drifts.
    """
    return _hold_unseen(dataclasses.replace(block, stations=CameraPositions.none(), more=_without(block, _POSITIONS)))


def without_attitudes(block: Block) -> Block:
    """Remove observed roll, pitch, yaw, also relative ones, and fix the boresight, which only they determine well."""
    return _hold_unseen(dataclasses.replace(block, attitudes=Attitudes.none(), more=_without(block, _TURNS)))


def without_control(block: Block) -> Block:
    """Convert control, weighted and fixed, to check points."""
    return control_only(block, ())


def control_only(block: Block, points: Collection[str]) -> Block:
    """Retain control only at the named `points`; the control at all others becomes check points.

    Raises ValueError for a name that has no control.
    """
    of = np.array(block.points, object)
    given = set(of[block.control.who]) | set(of[block.fixed.who])
    if unknown := [point for point in points if point not in given]:
        raise ValueError(f"{unknown[0]} is not a control point of this block; choose among {', '.join(sorted(given))}")
    chosen = np.isin(np.arange(len(of)), [k for k, point in enumerate(of) if point in set(points)])
    stay, held = chosen[block.control.who], chosen[block.fixed.who]
    return dataclasses.replace(
        block,
        control=block.control.take(stay),
        fixed=block.fixed.take(held),
        check=ControlCoordinates.joined(block.check, block.control.take(~stay), block.fixed.take(~held)),
    )


def with_control(block: Block, points: Collection[str], sigma: float | Float[np.ndarray, "3"] | None = None) -> Block:
    """Make the named `points` control, whether they were control or check points; all others become check points.

    A check coordinate without sigma gets `sigma` (`all_control`). Raises InputError for a point without coordinates.
    """
    of, groups = np.array(block.points, object), (block.control, block.fixed, block.check)
    given = {name for rows in groups for name in of[rows.who]}
    if unknown := [point for point in points if point not in given]:
        raise InputError(f"point {unknown[0]} has no surveyed coordinates; choose among {few(sorted(given))}")
    named = np.isin(np.arange(len(of)), [k for k, point in enumerate(of) if point in set(points)])
    kept, gone = ([rows.take(named[rows.who] == own) for rows in groups] for own in (True, False))
    control = ControlCoordinates.joined(kept[0], _as_control(kept[2], block.control, sigma))
    return dataclasses.replace(
        block, control=control, fixed=kept[1], check=ControlCoordinates.joined(gone[2], *gone[:2])
    )


def vertical_control(block: Block) -> Block:
    """Use vertical control only: Z of control and check points become control, X and Y check coordinates.

    A check coordinate without sigma gets the sigma of the control (`all_control`). Fixed heights remain fixed.
    """
    control, check, fixed = block.control, block.check, block.fixed
    upright = check.axis == 2
    return dataclasses.replace(
        block,
        control=ControlCoordinates.joined(control.take(control.axis == 2), _as_control(check.take(upright), control)),
        fixed=fixed.take(fixed.axis == 2),
        check=ControlCoordinates.joined(
            check.take(~upright), control.take(control.axis != 2), fixed.take(fixed.axis != 2)
        ),
    )


def all_control(block: Block, sigma: float | Float[np.ndarray, "3"] | None = None) -> Block:
    """Convert check points to control, each coordinate with its own sigma or, if it has none (zero), with `sigma`.

    `sigma` in m, one or one per axis; None: the sigma of the block's control on the axis. Raises ValueError if the
    block has none or several.
    """
    promoted = _as_control(block.check, block.control, sigma)
    return dataclasses.replace(
        block, control=ControlCoordinates.joined(block.control, promoted), check=ControlCoordinates.none()
    )


def hold_interior(block: Block, camera: str, values: Mapping[str, float]) -> Block:
    """Fix the interior orientation of `camera` at `values` (c_mm, k1 ...); others at their start values."""
    interior = block.start.unknowns.interior[camera]
    for name, value in values.items():
        interior = set_parameter(interior, name, value)
    held = jax.tree.map(lambda _: FIXED, interior)
    where = lambda b: (b.start.unknowns.interior[camera], b.priors.interior[camera])  # noqa: E731
    return eqx.tree_at(where, block, (interior, held))


def common_shift(block: Block, name: str = "block") -> Block:
    """Put all images in one strip, `name`, with a free shift: a datum offset between stations and control.

    Previous strips are removed.
    """
    zero = StripBias(jnp.zeros(3), jnp.zeros(3))
    known = lambda b: (b.start.unknowns.strips, b.priors.strips)  # noqa: E731
    priors = StripBias(FREE, FIXED)  # type: ignore[arg-type]
    joined = dataclasses.replace(block, image_strip=(name,) * len(block.images))
    return eqx.tree_at(known, joined, ({name: zero}, {name: priors}), is_leaf=lambda x: isinstance(x, dict))


def strips(block: Block, names: Collection[str]) -> Block:
    """Retain only the images of the strips `names`, and the points that at least two of them show.

    Cameras, mounts and strips without an image are removed, as are observations of removed objects; ids are unchanged.
    Raises ValueError for an unknown strip name.
    """
    if unknown := [name for name in names if not name or name not in block.image_strip]:
        known = ", ".join(sorted(set(block.image_strip) - {""}))
        raise ValueError(f"unknown strip {unknown[0]!r}; use one of {known or 'none'}")
    return some_images(block, np.array([strip in names for strip in block.image_strip]))


def without_images(block: Block, names: Collection[str]) -> Block:
    """Remove the named images, as `some_images` does. Raises InputError for an unknown image name."""
    if unknown := [name for name in names if name not in block.images]:
        raise InputError(f"unknown image {unknown[0]!r}; the block has {few(block.images)}")
    return some_images(block, np.array([image not in names for image in block.images]))


def some_images(block: Block, chosen: Bool[np.ndarray, "images"]) -> Block:
    """Retain only the images `chosen`, and the points that at least two of them show, as `strips` does."""
    image = np.flatnonzero(chosen)
    seen = block.image_points.point[np.isin(block.image_points.image, image)]
    point = np.flatnonzero(np.bincount(seen, minlength=len(block.points)) >= 2)
    return _part(block, image, point)


def without_observations(
    block: Block, left_out: Mapping[str, Bool[np.ndarray, "_"]]
) -> tuple[Block, Int[np.ndarray, "_"]]:
    """Remove some observations by group (`Block.named_observations`), and return the remaining points.

    Points with fewer observations left than coordinates, such as one ray, are removed with their observations.
    """
    kept = block.with_observations({name: block.named_observations[name].take(~out) for name, out in left_out.items()})
    numbers = np.zeros(len(block.points), int)
    for rows in kept.named_observations.values():
        for what, index in rows.indices():
            if what == "point":
                np.add.at(numbers, to_numpy(index).ravel(), np.repeat(len(rows.axes), np.size(index)))
    np.add.at(numbers, kept.fixed.who, 1)
    point = np.flatnonzero(numbers >= 3)
    return (kept, point) if len(point) == len(numbers) else (_part(kept, np.arange(len(block.images)), point), point)


def _part(block: Block, image: np.ndarray, point: np.ndarray) -> Block:
    """Return the block of some images and points, renumbered."""
    new_image, new_point = _numbers(image, len(block.images)), _numbers(point, len(block.points))
    images, points = [block.images[i] for i in image], [block.points[p] for p in point]
    camera, mount, strip = (
        tuple(of[i] for i in image) for of in (block.image_camera, block.image_mount, block.image_strip)
    )
    datum = block.datum
    kept = lambda rows: rows.renumbered(image=new_image, point=new_point)  # noqa: E731
    if isinstance(datum.over, tuple):
        datum = Datum(datum.kind, tuple(name for name in datum.over if name in set(points)), datum.scale)

    def owners(table):
        return {name for own in table.values() for name in np.array(block.owners(own.owner), object)[image]}

    def used(tree):
        return dataclasses.replace(
            tree,
            interior=_only(tree.interior, camera),
            mounts=_only(tree.mounts, mount),
            strips=_only(tree.strips, strip),
            more={kind: _only(table, owners(table)) for kind, table in tree.more.items()},
        )

    old = block.start
    start = dataclasses.replace(
        used(old.unknowns), exterior=_taken(old.unknowns.exterior, image), points=_taken(old.unknowns.points, point)
    )
    return dataclasses.replace(
        block,
        images=tuple(images),
        points=tuple(points),
        sensors=_only(block.sensors, camera),
        image_camera=camera,
        image_mount=mount,
        image_strip=strip,
        image_time=_taken(block.image_time, image),
        flight_time=_taken(block.flight_time, image),
        temperatures=_taken(block.temperatures, image),
        image_points=kept(block.image_points),
        control=kept(block.control),
        fixed=kept(block.fixed),
        check=kept(block.check),
        stations=kept(block.stations),
        attitudes=kept(block.attitudes),
        surfaces=kept(block.surfaces),
        distances=kept(block.distances),
        more=tuple(kept(rows) if isinstance(rows, AbstractObservations) else rows for rows in block.more),
        partitions={name: tuple(of[i] for i in image) for name, of in block.partitions.items()},
        datum=datum,
        start=dataclasses.replace(
            old, unknowns=start, image_known=old.image_known[image], point_known=old.point_known[point]
        ),
        priors=used(block.priors),
        motion=_taken(block.motion, image),
    )


def _exterior(block: Block):
    return block.start.unknowns.exterior


def _hold_unseen(block: Block) -> Block:
    """Fix mounts and strips that no remaining observation determines; remove the motion if no remaining parameter
    depends on it.
    """
    own = {_kind(rows) for rows in block.more}
    positions = len(block.stations.who) > 0 or bool(own & {*_POSITIONS})
    turns = len(block.attitudes.image) > 0 or bool(own & {*_TURNS})

    def unseen(b: Block) -> list:
        mounts, biases = b.priors.mounts.values(), b.priors.strips.values()
        held = [] if positions else [m.lever_arm for m in mounts] + [v for s in biases for v in (s.shift, s.drift)]
        held += [] if turns else [m.boresight for m in mounts]
        declared = [own for table in b.priors.more.values() for own in table.values() if not positions]
        moving = [own for own in declared if type(own).station is not AbstractParameters.station]
        held += [getattr(own, name) for own in moving for name in dynamic_fields(type(own))]
        return held + ([] if positions or turns else [m.time_offset for m in mounts])

    block = eqx.tree_at(unseen, block, replace_fn=lambda _: FIXED)
    late = late_cameras(block.start.unknowns, block.priors)
    return block if positions or turns or late else dataclasses.replace(block, motion=None)


def _without(block: Block, kinds: tuple[type, ...]) -> tuple:
    """Remove further observations of `kinds`, also from sets of correlated rows."""
    return tuple(rows for rows in block.more if _kind(rows) not in kinds)


def _kind(rows: AbstractObservations | KnownParameters) -> type:
    return type(rows.rows if isinstance(rows, Correlated) else rows)


def _as_control(
    check: ControlCoordinates, control: ControlCoordinates, sigma: float | Float[np.ndarray, "3"] | None = None
) -> ControlCoordinates:
    """Convert check coordinates to control; coordinates without a sigma get `sigma`, or the sigma of the control on
    their axis.
    """
    own, taken = to_numpy(check.sigma), np.zeros(3)
    if not len(check):
        return check
    if is_traced((own, control.sigma)):
        if sigma is None:
            raise InputError("inside a JAX transformation, give the sigma of check coordinates used as control")
        filled = jnp.where(own == 0, jnp.broadcast_to(jnp.asarray(sigma), 3)[check.axis], own)
        return dataclasses.replace(check, sigma=filled)
    for axis in np.unique(check.axis[own == 0]):
        of_axis = np.unique(np.asarray(control.sigma)[control.axis == axis])
        if sigma is None and len(of_axis) != 1:
            several = len(of_axis) or "no"
            raise ValueError(
                f"check coordinates in {AXES[axis]} have no sigma, and control has {several} sigmas in that axis "
                "instead of one; call all_control(block, sigma) first"
            )
        taken[axis] = of_axis[0] if sigma is None else np.broadcast_to(sigma, 3)[axis]
    return dataclasses.replace(check, sigma=np.where(own == 0, taken[check.axis], own))


def _numbers(kept: np.ndarray, n: int) -> np.ndarray:
    """Return the new index of each of `n` objects of which some are retained, -1 for the others."""
    new = np.full(n, -1)
    new[kept] = np.arange(len(kept))
    return new


def _taken(tree, index: np.ndarray):
    return jax.tree.map(lambda v: to_numpy(v)[index], tree)


def _only(table: dict, names: Collection[str]) -> dict:
    return {name: value for name, value in table.items() if name in names}
