"""Cameras grouped by model: one parameter table per group."""

import dataclasses

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Int

from jaxphoto.adjustment.model.parameter_tables import ParameterTable
from jaxphoto.block import Block
from jaxphoto.camera import InteriorOrientation
from jaxphoto.georeferencing import Exposure
from jaxphoto.parameters import filled, size_of


class CameraGroup(eqx.Module):
    """Cameras of one model. Their parameters are the rows of one table, so one `vmap` evaluates all of them."""

    names: tuple[str, ...] = eqx.field(static=True)
    treedef: jax.tree_util.PyTreeDef = eqx.field(static=True)
    offset: int = eqx.field(static=True)
    camera: Int[np.ndarray, "images"]
    """Camera (within the group) of each image; 0 if the image's camera belongs to another group."""
    member: Bool[np.ndarray, "images"]
    """True if the image's camera belongs to this group."""
    free_leaves: tuple[int, ...] = eqx.field(static=True)
    bent: jax.tree_util.PyTreeDef = eqx.field(static=True)
    """Tree of the interior orientation of an image, including parameters that modify it. It has more leaves if image
    rows move during exposure (`camera.RowMotion`).
    """


def interior_of(group: CameraGroup, table) -> InteriorOrientation:
    """Return the interior orientations of a parameter table with one column per parameter."""
    return jax.tree.unflatten(group.treedef if len(table) == group.treedef.num_leaves else group.bent, table)


def n_parameters(cameras: tuple[CameraGroup, ...]) -> int:
    """Return the number of parameters of all cameras."""
    return sum(len(g.names) * g.treedef.num_leaves for g in cameras)


def places_of_cameras(cameras: tuple[CameraGroup, ...]) -> np.ndarray | None:
    """Return the indices of the parameters of each image's camera (parameters, images); None if the models differ."""
    if len(cameras) != 1:
        return None
    (g,) = cameras
    m = g.treedef.num_leaves
    return g.offset + m * g.camera + np.arange(m)[:, None]


def camera_groups(block: Block, image_camera: np.ndarray) -> tuple[CameraGroup, ...]:
    """Return the camera groups of a block; `image_camera` names the camera of each image."""
    by_model: dict[jax.tree_util.PyTreeDef, list[str]] = {}
    for name, interior in block.start.unknowns.interior.items():
        by_model.setdefault(jax.tree.structure(interior), []).append(name)
    groups, offset = [], 0
    for treedef, names in by_model.items():
        member = np.isin(image_camera, names)
        ordered = np.array(sorted(names))
        place = np.array([names.index(n) for n in ordered], np.int32)
        camera = np.zeros(len(image_camera), np.int32)
        camera[member] = place[np.searchsorted(ordered, image_camera[member])]
        groups.append(CameraGroup(tuple(names), treedef, offset, camera, member, (), treedef))
        offset += len(names) * treedef.num_leaves
    return tuple(groups)


def with_free(group: CameraGroup, free: np.ndarray, tables: tuple[ParameterTable, ...]) -> CameraGroup:
    """Set the list of parameters that are free, or modified, in any camera of the group."""
    m = group.treedef.num_leaves
    own = free[(free >= group.offset) & (free < group.offset + m * len(group.names))] - group.offset
    moved, bending = {int(k) % m for k in own}, [t for t in tables if t.modifies_interior]
    bent = _bent_by(jax.tree.unflatten(group.treedef, [0.0] * m), [t.form for t in bending])
    fields = [path[-1].name for path, _ in jax.tree_util.tree_flatten_with_path(bent)[0]]
    for t in bending:
        moved |= {fields.index(name) for name in t.form[0].modifies_interior if name in fields}
    return dataclasses.replace(group, free_leaves=tuple(sorted(moved)), bent=jax.tree.structure(bent))


def _bent_by(interior: InteriorOrientation, forms: list) -> InteriorOrientation:
    """Return the tree of an interior orientation modified by parameters of these forms, without values."""
    still = np.zeros(3)

    def bent(interior: InteriorOrientation) -> InteriorOrientation:
        exposure = Exposure(0.0, still, still, np.eye(3), 0.0, 1.0, 0.0)  # type: ignore[arg-type]
        for form in forms:
            interior = filled(form, np.zeros(size_of(form))).interior(interior, exposure)
        return interior

    return jax.eval_shape(bent, interior) if forms else interior
