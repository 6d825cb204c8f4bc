"""What one meets first: names that can be found, short words of what a thing is, and clear ones for a wrong call."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxphoto
from jaxphoto import (
    Brown,
    Exposure,
    ExteriorOrientation,
    InputError,
    InteriorOrientation,
    Mount,
    StripBias,
    adjust,
    covariance,
    direct_orientation,
    image_ray,
    intersect,
    project,
)
from tests.blocks import adjusted, simulated
from tests.checked_types import unchecked

ROOMS = {"camera", "lidar", "stability", "experiment", "georeferencing", "extras", "io", "sensitivity"}
CAMERA = InteriorOrientation(35.0, 0.1, -0.2, Brown(k1=-9e-5))
ABOVE = ExteriorOrientation.from_angles(np.array([10.0, 20.0, 900.0]), np.array([0.01, -0.02, 0.3]))
LEVEL = ExteriorOrientation.from_angles(np.zeros((4, 3)), np.zeros((4, 3)))
NONE, STILL = StripBias(jnp.zeros(3), jnp.zeros(3)), Exposure(0.0, jnp.zeros(3), jnp.zeros(3))


def alone(program):
    """What a program prints in a process of its own."""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True, env=os.environ)
    return done.stdout.split()


@pytest.mark.parametrize("package", [jaxphoto, jaxphoto.io, jaxphoto.report], ids=lambda package: package.__name__)
def test_everything_can_be_found_by_tab(package):
    names = dir(package)
    assert set(package.__all__) <= set(names) and len(set(package.__all__)) == len(package.__all__)
    for name in names:
        assert getattr(package, name, None) is not None or name.startswith("__")
    with pytest.raises(AttributeError, match="no attribute 'no_such_room'"):
        _ = package.no_such_room


def test_all_rooms_can_be_found_by_tab():
    assert set(dir(jaxphoto)) >= ROOMS


def test_rooms_and_studies_are_imported_when_they_are_asked_for():
    late = ("lidar", "stability", "experiment", "io", "sensitivity", "extras")
    program = f"""
import sys, jaxphoto
print(*[r for r in {late} if f"jaxphoto.{{r}}" in sys.modules], "|")
print(*[getattr(jaxphoto, r).__name__ for r in {late}], jaxphoto.calibrate.__name__, jaxphoto.orient.__name__)
"""
    assert alone(program) == ["|", *(f"jaxphoto.{room}" for room in late), "calibrate", "orient"]


def test_a_block_and_an_adjustment_say_what_they_are_in_three_lines():
    result = adjusted("everything")
    assert len(repr(result.block).splitlines()) <= 3
    said = repr(result)
    assert len(said.splitlines()) <= 3
    assert said.startswith("Adjustment of 'simulated': converged after ")
    assert f"sigma naught {float(result.sigma0):.4g}, redundancy {result.redundancy}" in said
    assert f"{len(result.block.images)} images of 3 cameras" in repr(result.block)
    # While JAX maps over a block its leaves may be anything.
    known = covariance(result)
    assert "not converged" not in repr(known)
    assert repr(jax.tree.map(lambda _: None, known)).startswith("Covariance: traced")
    assert "not converged" in repr(covariance(adjust(simulated("cross").block, max_steps=1)))
    assert repr(jax.tree.map(lambda _: None, result.block)).startswith("Block 'simulated': ")


def test_plain_lists_are_arrays():
    with unchecked():
        xy = project(CAMERA, ABOVE, [1.0, 2.0, 30.0])
        np.testing.assert_array_equal(xy, project(CAMERA, ABOVE, jnp.array([1.0, 2.0, 30.0])))
        bare = ExteriorOrientation([10.0, 20.0, 900.0], np.asarray(ABOVE.camera_from_object).tolist())
        np.testing.assert_array_equal(project(CAMERA, bare, (1, 2, 30)), xy)
        origin, direction = image_ray(CAMERA, ABOVE, list(map(float, xy)))
        np.testing.assert_allclose(np.cross(direction, np.array([1.0, 2, 30]) - origin), 0, rtol=0, atol=1e-9)
        np.testing.assert_allclose(intersect([[0, 0, 0], [1, 0, 0]], [[0, 0, 1], [-1, 0, 0]]), 0, rtol=0, atol=1e-15)
        assert CAMERA.ideal_from_measured([1.0, 2.0]).shape == CAMERA.measured_from_ideal([1, 2]).shape == (2,)
        found = direct_orientation([1.0, 2.0, 3.0], [0, 0, 0], Mount(jnp.zeros(3), jnp.zeros(3)), NONE, STILL)
        np.testing.assert_array_equal(found.position, [1, 2, 3])


MANY = np.ones((5, 3))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: project(CAMERA, ABOVE, MANY), r"point has shape \(5, 3\) where \(3,\) is required"),
        (lambda: project(CAMERA, LEVEL, MANY[0]), r"exterior.position has shape \(4, 3\) where \(3,\) is required"),
        (lambda: image_ray(CAMERA, LEVEL, MANY[0, :2]), r"exterior.position has shape \(4, 3\)"),
        (lambda: image_ray(CAMERA, ABOVE, MANY[:, :2]), r"xy has shape \(5, 2\) where \(2,\) is required"),
        (lambda: image_ray(CAMERA, ABOVE, MANY[0]), r"xy has shape \(3,\) where \(2,\) is required"),
        (lambda: CAMERA.ideal_from_measured(MANY[:, :2]), r"xy has shape \(5, 2\) where \(2,\) is required"),
        (lambda: intersect(MANY, MANY[:3]), r"directions has shape \(3, 3\) where \(5, 3\) is required"),
        (lambda: intersect(MANY[None], MANY[None]), r"origins has shape \(1, 5, 3\) where \(n, 3\) is required"),
        (lambda: project(CAMERA, ABOVE, ["1", "x", "2"]), r"point must be an array of numbers of shape \(3,\)"),
        (
            lambda: direct_orientation(MANY, MANY, None, NONE, STILL),
            r"station has shape \(5, 3\) where \(3,\) is required",
        ),
    ],
)
def test_a_forgotten_vmap_is_named(call, message):
    with unchecked(), pytest.raises(InputError, match=message):
        call()


def test_pseudo_control_takes_a_cloud_as_heights_do():
    from jaxphoto.cloud import Cloud
    from jaxphoto.lidar import index_cloud, pseudo_control_points

    rng = np.random.default_rng(4)
    xyz = np.column_stack([rng.uniform(-60, 60, (4000, 2)), rng.normal(0, 0.02, 4000)])
    xy = np.array([[0.0, 0.0], [0.5, -0.3]])
    above = ExteriorOrientation.from_angles(np.array([0.0, 0.0, 900.0]), np.zeros(3))
    ours = pseudo_control_points(CAMERA, above, xy, Cloud(xyz))
    np.testing.assert_array_equal(ours.xyz, pseudo_control_points(CAMERA, above, xy, index_cloud(xyz)).xyz)
