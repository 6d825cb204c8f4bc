"""Heights of a cloud as control: they calibrate the camera, and are refused where they would not be true."""

import dataclasses
import functools

import numpy as np
import pytest

from jaxphoto import BlockError, DatumError, InputError, covariance
from jaxphoto.cloud import Cloud
from jaxphoto.lidar import HeightFlag, HeightSettings
from jaxphoto.observations import CameraPositions, ControlCoordinates
from jaxphoto.procedures.lidar import LidarControl, lidar_control
from tests.marks import slow_but
from tests.procedures.lidar import scanned, triplet

SETTINGS = HeightSettings(sigma_z_m=0.1, sigma_xy_m=0.3)


@functools.cache
def controlled(method: str) -> LidarControl:
    return lidar_control(scanned().block, scanned().cloud, method, SETTINGS)


def errors(control: LidarControl) -> np.ndarray:
    """Of shared unknowns over their standard deviations."""
    a, truth = control.adjusted, scanned().truth.interior["kodak"]
    true = np.array([truth.c, truth.xp, truth.yp, truth.distortion.k1, truth.distortion.k2])
    known = covariance(a)
    return (np.asarray(a.values.shared)[a.structure.free] - true) / np.asarray(known.shared_sigma)


@pytest.mark.parametrize("method", slow_but(("plane",), ("plane", "local", "image")))
def test_heights_alone_calibrate_the_camera(method):
    control = controlled(method)
    assert control.converged and bool(control.adjusted.converged)
    assert (np.abs(errors(control)) < 3).all()
    # And they are what does it: the block by itself knows c many times worse.
    assert (control.block.control.axis == 2).all() and len(control.block.control.who) == control.used.sum()
    assert 0.8 < float(control.adjusted.sigma0) < 1.2


def test_heights_are_within_their_standard_deviations():
    control = controlled("plane")
    truth = scanned().truth.points[control.points, 2]
    off = ((control.height - truth) / control.sigma)[control.used]
    assert len(off) > 60
    # On roofs and slopes they are given some more than they need, for the place of the point.
    assert 0.55 < np.sqrt((off**2).mean()) < 1.25


def test_what_cannot_be_told_is_no_control():
    control = controlled("plane")
    refused = ~np.isfinite(control.height)
    assert refused.any()
    assert (
        control.flag[refused] & int(HeightFlag.HOLE | HeightFlag.EDGE | HeightFlag.VEGETATION | HeightFlag.BREAKLINE)
    ).all()
    assert not control.used[refused].any()


def test_the_result_starts_where_it_ended():
    control = controlled("plane")
    start = control.block.start
    assert start.image_known.all() and start.point_known.all()
    np.testing.assert_array_equal(start.unknowns.points, control.adjusted.unknowns.points)


def test_a_wrong_height_is_left_out():
    """A container on the ground where one point is: the images say that the point is not on it."""
    cloud, point = scanned().cloud, controlled("plane").points[controlled("plane").used][4]
    place = scanned().truth.points[point]
    under = np.hypot(*(cloud.xyz[:, :2] - place[:2]).T) < 12
    raised = dataclasses.replace(cloud, xyz=cloud.xyz + np.where(under[:, None], [0, 0, 4.0], 0.0))
    control = lidar_control(scanned().block, raised, "plane", SETTINGS)
    where = int(np.flatnonzero(control.points == point)[0])
    assert np.isfinite(control.height[where]) and not control.used[where]
    assert control.used.sum() > 60 and (np.abs(errors(control)) < 3.5).all()


def test_only_points_named():
    names = scanned().block.points[:40]
    control = lidar_control(scanned().block, scanned().cloud, "plane", SETTINGS, points=names, max_rounds=1)
    assert [scanned().block.points[p] for p in control.points] == list(names)


@pytest.mark.slow
def test_a_triplet_is_calibrated_by_pseudo_control():
    """Paper 001: three images of a strip, 30 features, four laser points each; stations on a line leave roll open."""
    flight, settings = triplet(), HeightSettings(points=4, sigma_z_m=0.1, sigma_xy_m=0.3)
    control = lidar_control(flight.block, flight.cloud, "image", settings)
    a, c = control.adjusted, flight.truth.interior["kodak"].c
    (sigma,) = np.asarray(covariance(a).shared_sigma) / float(a.sigma0)
    assert control.converged
    assert abs(float(a.unknowns.interior["kodak"].c) - c) < 3 * sigma
    # At best: stations and heights together say how high the camera flies over the points. (The base of so few images,
    # as good as two stations, allows much less.)
    height = float(np.mean(flight.truth.exterior.position[:, 2]) - np.mean(flight.truth.points[:, 2]))
    best = float(c) / height * np.sqrt(0.1**2 / 3 + np.mean(control.sigma[control.used] ** 2) / control.used.sum())
    base = np.linalg.norm(np.diff(flight.truth.exterior.position[[0, -1]], axis=0))
    assert best <= sigma < 5 * float(c) * np.sqrt(2) * 0.1 / base


@pytest.mark.parametrize(
    ("change", "points", "error", "said"),
    [
        (lambda b: b, ("nobody",), InputError, "unknown point nobody"),
        (lambda b: _with_height(b, 0), (0,), InputError, "is already control"),
        (lambda b: _all_checked(b), None, BlockError, "no tie point"),
        (lambda b: dataclasses.replace(b, stations=CameraPositions.none()), None, DatumError, "camera stations"),
    ],
)
def test_what_has_no_answer_is_refused(change, points, error, said):
    block = change(scanned().block)
    names = None if points is None else tuple(block.points[p] if isinstance(p, int) else p for p in points)
    with pytest.raises(error, match=said):
        lidar_control(block, scanned().cloud, "plane", SETTINGS, points=names)


def test_a_cloud_elsewhere_is_refused_with_both_extents():
    cloud = Cloud(scanned().cloud.xyz[:5000] + np.array([5e4, 0, 0]))
    with pytest.raises(BlockError, match=r"does not cover the block: its points lie at X .* those of the block at X"):
        lidar_control(scanned().block, cloud, "plane", SETTINGS)


def _with_height(block, point):
    return dataclasses.replace(
        block, control=ControlCoordinates(np.array([point]), np.array([2]), np.zeros(1), np.ones(1))
    )


def _all_checked(block):
    n = len(block.points)
    return dataclasses.replace(block, check=ControlCoordinates(np.arange(n), np.full(n, 2), np.zeros(n), np.zeros(n)))
