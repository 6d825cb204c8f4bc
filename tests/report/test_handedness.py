"""Blocks under the ground: mirrored control or stations fit as well as true ones."""

import equinox as eqx
import numpy as np

from jaxphoto import adjust
from tests.blocks import simulated

# Half a turn about X.
TURN = np.diag([1.0, -1.0, -1.0])


def turned(block):
    """The block below its points, with the control and the start that fit there: y and z have the other sign."""
    signs = np.array([1.0, -1.0, -1.0])
    exterior = block.start.unknowns.exterior
    places = lambda b: (  # noqa: E731
        b.control.value, b.stations.value, b.start.unknowns.points, b.start.unknowns.exterior.position,
        b.start.unknowns.exterior.camera_from_object,
    )  # fmt: skip
    flip = lambda rows: np.asarray(rows.value) * signs[np.asarray(rows.axis)]  # noqa: E731
    return eqx.tree_at(
        places, block,
        (flip(block.control), flip(block.stations), np.asarray(block.start.unknowns.points) * signs,
         np.asarray(exterior.position) * signs, np.asarray(exterior.camera_from_object) @ TURN),
    )  # fmt: skip


def test_cameras_that_look_up_from_below_are_told():
    block = simulated("cross").block
    assert "looking_up" in {f.code for f in adjust(turned(block)).verdict().findings}
    assert "looking_up" not in {f.code for f in adjust(block).verdict().findings}
