"""Images whose phi is near 90 degrees: omega and kappa are not separable, their rotations about the camera axes are."""

import dataclasses

import equinox as eqx
import numpy as np

from jaxphoto import Tables, adjust, covariance
from jaxphoto.report import verdict_of
from tests.blocks import adjusted_example, example

# X' = Z, Y' = Y, Z' = -X.
TURN = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])


def turned(block):
    """The block in a frame whose X axis is the vertical: nadir images have phi of about 90 degrees."""

    def rows(group):
        axis, value = np.asarray(group.axis), np.asarray(group.value)
        new = np.choose(axis, [2, 1, 0])
        return dataclasses.replace(group, axis=new, value=np.where(new == 2, -value, value))

    start = block.start.unknowns
    exterior = dataclasses.replace(
        start.exterior,
        position=np.asarray(start.exterior.position) @ TURN.T,
        camera_from_object=np.asarray(start.exterior.camera_from_object) @ TURN.T,
    )
    unknowns = dataclasses.replace(start, exterior=exterior, points=np.asarray(start.points) @ TURN.T)
    block = block.with_observations(
        {
            name: rows(group)
            for name, group in block.named_observations.items()
            if name in ("control_points", "stations")
        }
    )
    return eqx.tree_at(lambda b: b.start.unknowns, block, unknowns)


def test_angles_near_the_singularity_are_given_about_the_axes_of_the_camera():
    block = example()
    start = dataclasses.replace(block.start, unknowns=adjusted_example().unknowns)
    known = dataclasses.replace(
        start, image_known=np.ones(len(block.images), bool), point_known=np.ones(len(block.points), bool)
    )
    adjusted = adjust(turned(dataclasses.replace(block, start=known)))
    tables = Tables(adjusted)
    assert tables.inseparable_angles.all()
    angles = tables.exterior[["sigma_omega_deg", "sigma_phi_deg", "sigma_kappa_deg"]]
    assert not (angles > 180).any(axis=None)
    about_axes = tables.exterior[[f"sigma_r{axis}_deg" for axis in "xyz"]]
    upright = np.degrees(np.asarray(covariance(adjusted_example(), "camera").exterior_sigma)[:, 3:])
    np.testing.assert_allclose(about_axes, upright, rtol=1e-3)
    findings = {f.code: f.text for f in verdict_of(tables).findings}
    assert "inseparable_angles" in findings and "omega and kappa" not in findings.get("correlation_image", "")
    assert "sigma_rx_deg" not in Tables(adjusted_example()).exterior
