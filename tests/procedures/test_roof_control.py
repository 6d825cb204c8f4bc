"""Tie points on roof faces, and centroids of roofs, as control."""

import functools

import numpy as np
import pytest

from jaxphoto import BlockError, covariance
from jaxphoto.cloud import Cloud
from jaxphoto.lidar import HeightSettings
from jaxphoto.procedures.lidar import RoofControl, roof_control
from tests.procedures.lidar import scanned

SETTINGS = HeightSettings(sigma_z_m=0.1, sigma_xy_m=0.3)


@functools.cache
def on_roofs() -> RoofControl:
    return roof_control(scanned().block, scanned().cloud, SETTINGS)


def test_points_on_roofs_are_held_on_their_planes():
    found = on_roofs()
    assert found.converged and found.faces > 2 and len(found.points) >= found.faces
    truth = scanned().truth.points[found.points]
    rows = found.block.surfaces
    # The true points are on the planes as far as these are known, and true roofs slope.
    off = np.einsum("nk,nk->n", np.asarray(rows.normal), truth - np.asarray(rows.foot)) / np.asarray(rows.sigma)
    assert (np.abs(off) < 4).all()
    assert np.asarray(rows.normal)[:, 2].min() < 0.99
    assert (np.asarray(rows.sigma) < 0.1).all()


def test_roofs_and_heights_calibrate_the_camera():
    a, truth = on_roofs().adjusted, scanned().truth.interior["kodak"]
    known = covariance(a)
    true = [truth.c, truth.xp, truth.yp, truth.distortion.k1, truth.distortion.k2]
    off = (np.asarray(a.values.shared)[a.structure.free] - true) / np.asarray(known.shared_sigma)
    assert (np.abs(off) < 3.5).all()


def test_a_centroid_is_control_in_three_dimensions():
    """A tie point taken for the centroid of its roof: control where the mean of the face's laser points is."""
    name = scanned().block.points[on_roofs().points[0]]
    # The point is not the centroid, so the observations disagree.
    with pytest.warns(UserWarning, match="sigma naught"):
        found = roof_control(scanned().block, scanned().cloud, SETTINGS, centroids=[name], max_rounds=1)
    control = found.block.control
    own = np.flatnonzero(control.who == on_roofs().points[0])
    assert control.axis[own].tolist() == [0, 1, 2]
    # Of all others heights only, and of those on roofs not even that.
    others = np.delete(np.arange(len(control.who)), own)
    assert (control.axis[others] == 2).all() and not np.isin(found.points, control.who).any()
    assert name not in [scanned().block.points[p] for p in found.points]
    place = scanned().truth.points[on_roofs().points[0]]
    assert np.hypot(*(np.asarray(control.value)[own[:2]] - place[:2])) < 30
    assert (np.asarray(control.sigma)[own] < 2).all()


def test_a_cloud_without_roofs_is_refused():
    cloud = scanned().cloud
    bare = cloud.take(np.flatnonzero(cloud.classification == 2))
    with pytest.raises(BlockError, match="laser points of roofs"):
        roof_control(scanned().block, bare, SETTINGS)


def test_points_beside_all_roofs_are_refused():
    """The one roof stands 30 m beside the one point asked for."""
    cloud, point = scanned().cloud, on_roofs().points[0]
    roof = scanned().truth.points[point] + np.array([30.0, 0.0, 0.0])
    rng = np.random.default_rng(1)
    points = roof + rng.uniform(-4, 4, (100, 3)) * [1, 1, 0] + rng.normal(0, 0.1, (100, 3))
    classes = np.where(cloud.classification == 6, 1, cloud.classification).astype(np.uint8)
    one = Cloud(np.vstack([cloud.xyz, points]), np.concatenate([classes, np.full(100, 6, np.uint8)]))
    with pytest.raises(BlockError, match="none of 1 tie points lies on one of the cloud's 1 roof faces"):
        roof_control(scanned().block, one, SETTINGS, points=[scanned().block.points[point]], max_rounds=3)
