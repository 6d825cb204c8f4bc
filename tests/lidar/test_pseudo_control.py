"""Pseudo control points: the paper's formula, derivatives, how good the heights are, what is refused, convergence."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

from jaxphoto import ExteriorOrientation, InteriorOrientation, project
from jaxphoto.camera import Brown
from jaxphoto.cloud import Cloud
from jaxphoto.compiling import run
from jaxphoto.errors import InputError
from jaxphoto.lidar.grid import index_cloud
from jaxphoto.lidar.heights import HeightFlag, HeightSettings
from jaxphoto.lidar.pseudo_control import pseudo_control_points
from tests.derivatives import compiled

POINTS = 32400
HEIGHT = 1000.0
CAMERA = InteriorOrientation(34.0, 0.06, 0.27, Brown(k1=-9e-5))
NOISE = (0.5, 0.15)
SLOPE = np.tan(np.pi / 6)

projected = compiled(jax.vmap(project, (None, None, 0)))
ideal = compiled(CAMERA.ideal_from_measured)


def image(tilt_deg: float) -> ExteriorOrientation:
    """Looks straight down, from where the middle of the ground is seen at an angle of `tilt_deg` off the nadir."""
    east = -np.tan(np.deg2rad(tilt_deg)) * HEIGHT
    return ExteriorOrientation.from_angles(np.array([east, 0.0, HEIGHT]), np.array([0.01, -0.02, 0.3]))


def measured(exterior, points):
    return np.array(projected(CAMERA, exterior, points))


def scanned(surface, density, rng, noise=NOISE):
    """As many laser points each time, so over less ground if they are dense: off by noise in X, Y and Z."""
    half = np.sqrt(POINTS / density) / 2
    xy = rng.uniform(-half, half, (POINTS, 2))
    return np.column_stack([xy, surface(xy)]) + rng.normal(size=(len(xy), 3)) * [noise[0], noise[0], noise[1]]


def indexed(cloud):
    """With room for the fullest of all cells here: all tests share their programs."""
    return dataclasses.replace(index_cloud(cloud), most=48)


# The ground of a slope towards a heading, and 25 houses of 12 x 16 m on level ground, flat or with a ridge north-south.
def slope(angle_deg, heading_deg):
    g = np.tan(np.deg2rad(angle_deg)) * np.array([np.sin(np.deg2rad(heading_deg)), np.cos(np.deg2rad(heading_deg))])
    return lambda xy: 100 + xy @ g


def from_house(xy):
    return (xy + 12) % 24 - 12


def houses(pitch):
    def surface(xy):
        off = np.abs(from_house(xy))
        inside = (off[:, 0] < 6) & (off[:, 1] < 8)
        return np.where(inside, 107 + pitch * (6 - off[:, 0]), 100.0)

    return surface


def anywhere(rng, n, density):
    half = np.sqrt(POINTS / density) / 2 - 10
    return rng.uniform(-half, half, (n, 2))


def on_roofs(rng, n, density):
    """Well inside: 1.5 m from the eaves, 1.5 m from the ridge."""
    off = np.column_stack([rng.uniform(1.5, 4.5, n) * rng.choice([-1, 1], n), rng.uniform(-6.5, 6.5, n)])
    return rng.integers(-1, 2, (n, 2)) * 24 + off


def direct(exterior, xy, cloud, n, power):
    """The paper's steps, feature by feature, without an index."""
    shown = measured(exterior, cloud)
    position, m = np.asarray(exterior.position), np.asarray(exterior.camera_from_object)
    result = []
    for at in xy:
        distance = np.linalg.norm(shown - at, axis=1)
        near = np.argsort(distance)[:n]
        weight = np.maximum(distance[near], 1e-12) ** -power
        z = weight @ cloud[near, 2] / weight.sum()
        ray = m.T @ [*ideal(at), -CAMERA.c]
        result.append(position + ray * (z - position[2]) / ray[2])
    return np.array(result)


@pytest.mark.parametrize("power", [1.0, 2.0])
def test_is_the_papers_formula(power):
    rng = np.random.default_rng(1)
    cloud = scanned(slope(15, 60), 2, rng)
    exterior = image(20)
    xy = measured(exterior, np.column_stack([anywhere(rng, 60, 2), np.full(60, 100.0)]))
    # A laser point that the image shows in the very place of the feature.
    xy[7] = measured(exterior, cloud[700:701])[0]
    settings = HeightSettings(power=power, refuse=HeightFlag.OK)
    found = pseudo_control_points(CAMERA, exterior, xy, indexed(cloud), settings)
    np.testing.assert_allclose(found.xyz, direct(exterior, xy, cloud, 8, power), rtol=0, atol=1e-9)
    np.testing.assert_allclose(found.xyz[7], cloud[700], rtol=0, atol=1e-8)
    # X and Y on the ray: the image shows them where they were measured.
    np.testing.assert_allclose(measured(exterior, found.xyz), xy, rtol=0, atol=1e-10)


@functools.cache
def errors(ground, density, tilt, noise=NOISE, seed=0):
    """Height errors of 1,000 features, their sigmas, and which are without a flag."""
    surface, places = GROUNDS[ground]
    rng = np.random.default_rng(seed)
    grid = indexed(scanned(surface, density, rng, noise))
    xy = places(rng, 1000, density)
    truth = np.column_stack([xy, surface(xy)])
    exterior = image(tilt)
    settings = HeightSettings(sigma_xy_m=noise[0], sigma_z_m=noise[1])
    found = pseudo_control_points(CAMERA, exterior, measured(exterior, truth), grid, settings)
    assert (np.isfinite(found.sigma_z) == (np.asarray(found.flag) == 0)).all()
    return found.xyz[:, 2] - truth[:, 2], np.asarray(found.sigma_z), np.asarray(found.flag)


GROUNDS = {
    "level": (slope(0, 0), anywhere),
    "slope away": (slope(30, 90), anywhere),
    "slope towards": (slope(30, 270), anywhere),
    "slope across": (slope(15, 0), anywhere),
    "flat roofs": (houses(0.0), on_roofs),
    "gable roofs": (houses(SLOPE), on_roofs),
    "rolling": (lambda xy: 100 + 6 * np.sin(xy[:, 0] / 25) + 5 * np.cos(xy[:, 1] / 18), anywhere),
}


@pytest.mark.parametrize("tilt", [0, 20])
@pytest.mark.parametrize("density", [1, 4])
@pytest.mark.parametrize("ground", GROUNDS)
def test_ninety_five_percent_of_the_heights_are_within_the_predicted_sigma(ground, density, tilt):
    error, sigma, flag = errors(ground, density, tilt)
    good = flag == 0
    assert good.mean() > (0.8 if "roofs" in ground else 0.99)
    assert abs(np.mean(np.abs(error[good]) < 1.96 * sigma[good]) - 0.95) <= 0.02
    # No height of the wrong level, such as that of the ground that a roof hides.
    assert np.abs(error[good]).max() < 1.6


def test_sigma_of_an_accurate_lidar():
    """What is left is that the weighted mean does not reproduce a slope."""
    error, sigma, flag = errors("slope away", 2, 20, noise=(0.05, 0.02))
    good = flag == 0
    assert abs(np.mean(np.abs(error[good]) < 1.96 * sigma[good]) - 0.95) <= 0.02
    assert np.median(sigma[good]) < 0.1


def test_flags():
    rng = np.random.default_rng(4)
    cloud = scanned(slope(0, 0), 2, rng)
    cloud = cloud[np.hypot(cloud[:, 0], cloud[:, 1]) > 8]
    leaves = (cloud[:, 0] > 26) & (cloud[:, 1] > 26)
    classes = np.where(leaves, 5, 2).astype(np.uint8)
    grid = indexed(Cloud(cloud, classification=classes))
    exterior = image(10)
    places = np.array([[0, 0], [5, -2], [68, 0], [-200, 0], [33, 33], [-30, 30], [0, 25.0]])
    xy = measured(exterior, np.column_stack([places, np.full(len(places), 100.0)]))
    found = pseudo_control_points(CAMERA, exterior, xy, grid)
    flag = np.asarray(found.flag)
    assert (flag[:2] & HeightFlag.HOLE).all()
    assert (flag[2:4] & (HeightFlag.HOLE | HeightFlag.EDGE)).all()
    assert flag[4] == HeightFlag.VEGETATION
    assert (flag[5:] == 0).all()
    assert (np.isnan(found.xyz).all(axis=1) == (flag != 0)).all()
    told = pseudo_control_points(CAMERA, exterior, xy, grid, HeightSettings(refuse=HeightFlag.HOLE))
    assert np.isfinite(told.xyz[4]).all()
    upwards = ExteriorOrientation.from_angles(np.array([0.0, 0, 90]), np.array([np.pi, 0.0, 0]))
    assert (pseudo_control_points(CAMERA, upwards, xy, grid).flag == HeightFlag.HOLE).all()


def test_features_at_the_eaves_are_refused_rather_than_put_between_roof_and_ground():
    rng = np.random.default_rng(5)
    surface = houses(0.0)
    grid, exterior = indexed(scanned(surface, 2, rng)), image(0)
    along = rng.uniform(-6, 6, 1000)
    off = rng.uniform(-0.3, 0.3, 1000)
    places = np.column_stack([6 + off, along])
    truth = np.column_stack([places, surface(places)])
    found = pseudo_control_points(CAMERA, exterior, measured(exterior, truth), grid)
    broken = (np.asarray(found.flag) & HeightFlag.BREAKLINE) != 0
    assert broken.mean() > 0.9
    between = np.abs(np.asarray(found.xyz[:, 2]) - 103.5) < 2.5
    assert between.mean() < 0.002


def test_no_program_is_compiled_for_another_camera_image_or_cloud_of_like_size():
    rng = np.random.default_rng(6)
    grid = indexed(scanned(slope(5, 0), 2, rng))
    other = indexed(np.asarray(grid.xyz)[: len(grid)] + np.array([5.0, 3.0, 1.0]))
    xy = rng.uniform(-1, 1, (900, 2))
    pseudo_control_points(CAMERA, image(0), xy, grid)
    programs = set(run._programs)
    camera = InteriorOrientation(35.0, 0.0, 0.1, Brown(k1=-8e-5))
    pseudo_control_points(camera, image(5), xy[:800], other, HeightSettings(sigma_z_m=0.1, power=3.0))
    assert set(run._programs) == programs


def test_wrong_use_is_told_in_a_sentence():
    grid = indexed(scanned(slope(0, 0), 1, np.random.default_rng(7)))
    with pytest.raises(InputError, match="give one or more image coordinates"):
        pseudo_control_points(CAMERA, image(0), np.zeros((0, 2)), grid)


def test_derivatives_are_those_of_differences():
    rng = np.random.default_rng(3)
    grid = indexed(scanned(slope(20, 100), 2, rng))
    exterior = image(20)
    xy = measured(exterior, np.column_stack([anywhere(rng, 40, 2), np.full(40, 100.0)]))
    # A laser point that the image shows in the very place of the feature.
    xy[0] = measured(exterior, np.asarray(grid.xyz)[700:701])[0]
    settings = HeightSettings(refuse=HeightFlag.OK)
    # c, x_p, y_p, k1, position, angles; and a shift of all features.
    theta = np.array([34.0, 0.06, 0.27, -9e-5, *np.asarray(exterior.position), 0.01, -0.02, 0.3, 0, 0])
    # So small that hardly any neighbour changes: where one does, the feature is off by orders of magnitude.
    step = np.array([1e-6, 1e-6, 1e-6, 1e-9, 1e-4, 1e-4, 1e-4, 1e-8, 1e-8, 1e-8, 1e-6, 1e-6])

    def points(theta):
        interior = InteriorOrientation(theta[0], theta[1], theta[2], Brown(k1=theta[3]))
        taken = ExteriorOrientation.from_angles(theta[4:7], theta[7:10])
        return pseudo_control_points(interior, taken, xy + theta[10:], grid, settings).xyz

    differences = np.stack([(points(theta + d) - points(theta - d)) / (2 * d.sum()) for d in np.diag(step)], axis=-1)
    exact = np.asarray(jax.jit(jax.jacfwd(points))(theta))
    wrong = np.abs(exact - differences).max(axis=1) > 1e-4 * np.abs(differences).max(axis=(0, 1))
    assert wrong.any(axis=1).sum() <= 1
    assert np.abs(differences[:, 2]).max(axis=0).min() > 0
    backward = jax.jit(jax.grad(lambda theta: points(theta)[:, 2].mean()))(theta)
    np.testing.assert_allclose(backward, exact[:, 2].mean(axis=0), rtol=1e-9, atol=1e-12)
