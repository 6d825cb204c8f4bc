"""Direct georeferencing: points of an adjustment with fixed images, and correct covariances."""

import dataclasses
import functools

import equinox as eqx
import jax
import numpy as np
import pytest

from jaxphoto import BlockError, Weighted, adjust, georeference
from jaxphoto.block import Block, Corrections
from jaxphoto.camera import set_parameter
from jaxphoto.georeferencing import Mount
from jaxphoto.variants import direct, without_attitudes, without_control
from tests import blocks, formulas

ARM_SIGMA, BORESIGHT_SIGMA = np.array([0.03, 0.02, 0.04]), np.array([4e-4, 3e-4, 5e-4])
INTERIOR_SIGMA = {"c_mm": 0.008, "xp_mm": 0.005, "k1": 3e-7}


def known(name: str, **changes) -> tuple[Block, object]:
    """A simulated block whose cameras, mounts and strips are the true ones, with sigmas of mount and camera."""
    block, truth = blocks.simulated(name)
    held = jax.tree.map(lambda _: blocks.FIXED, truth.interior)
    block = eqx.tree_at(lambda b: (b.start.unknowns, b.priors.interior), block, (truth, held))
    return dataclasses.replace(block, **changes), truth


@functools.cache
def uncertain() -> tuple[Block, object]:
    block, truth = known("mount")
    mount = Mount(Weighted(np.zeros(3), ARM_SIGMA), Weighted(np.zeros(3), BORESIGHT_SIGMA), blocks.FIXED)
    camera = block.priors.interior["one"]
    for name, sigma in INTERIOR_SIGMA.items():
        camera = set_parameter(camera, name, Weighted(0.0, sigma))
    return eqx.tree_at(lambda b: (b.priors.mounts["imu"], b.priors.interior["one"]), block, (mount, camera)), truth


@functools.cache
def result():
    return georeference(uncertain()[0])


def test_points_are_those_of_an_adjustment_with_held_images():
    block = uncertain()[0]
    held = direct(without_control(block))
    held = eqx.tree_at(
        lambda b: b.priors.interior, held, jax.tree.map(lambda _: blocks.FIXED, block.start.unknowns.interior)
    )
    adjusted, got = adjust(held, held.start.unknowns), result()
    assert got.points == block.points and got.images == block.images
    np.testing.assert_allclose(got.positions, adjusted.unknowns.points, rtol=0, atol=1e-6)
    np.testing.assert_allclose(got.exterior.position, adjusted.unknowns.exterior.position, rtol=0, atol=1e-9)


def drawn(block: Block, rng, n: int, image: np.ndarray):
    """NumPy: (n, images) projection centres and rotations under errors of sensors and of the one mount they share."""
    angles = np.asarray(block.attitudes.roll_pitch_yaw)[image]
    station = np.asarray(block.stations.value).reshape(-1, 3)[image]
    shape = (n, len(image), 3)
    station = station + 0.02 * rng.normal(size=shape)
    angles = angles + np.asarray(block.attitudes.sigma)[image] * rng.normal(size=shape)
    arm = blocks.LEVER_ARM + ARM_SIGMA * rng.normal(size=(n, 1, 3)) + np.zeros(shape)
    boresight = blocks.BORESIGHT + BORESIGHT_SIGMA * rng.normal(size=(n, 1, 3)) + np.zeros(shape)
    position, matrix = formulas.direct(*(v.reshape(-1, 3) for v in (station, angles, arm, boresight)))
    return position.reshape(shape), matrix.reshape(*shape, 3)


def intersected(c, ideal, position, matrix, start):
    """NumPy: Gauss-Newton on collinearity for all draws at once, equal weights."""
    point = np.repeat(start[None], len(position), axis=0)
    for _ in range(4):
        u = np.einsum("nrij,nrj->nri", matrix, point[:, None] - position)
        computed = -c[:, None, None] * u[..., :2] / u[..., 2:]
        by = -c[:, None, None, None] * matrix[:, :, :2] / u[..., 2:, None]
        by -= computed[..., None] * matrix[:, :, 2:] / u[..., 2:, None]
        normal = np.einsum("nrki,nrkj->nij", by, by)
        right = np.einsum("nrki,nrk->ni", by, ideal - computed)
        point = point + np.linalg.solve(normal, right[..., None])[..., 0]
    return point


@pytest.mark.parametrize("p", [0, 24])
def test_point_covariance_is_the_scatter_of_many_draws(p):
    block, truth = uncertain()
    rows = block.image_points
    mine = rows.point == p
    rng, n = np.random.default_rng(p), 3000
    position, matrix = drawn(block, rng, n, rows.image[mine])
    camera = truth.interior["one"]
    error = {name: sigma * rng.normal(size=n) for name, sigma in INTERIOR_SIGMA.items()}
    xy = np.asarray(rows.xy)[mine] + 0.004 * rng.normal(size=(n, mine.sum(), 2))
    reduced = xy - np.stack([camera.xp + error["xp_mm"], np.full(n, camera.yp)], 1)[:, None]
    r2 = (reduced**2).sum(2)
    k1 = camera.distortion.k1 + error["k1"][:, None]
    ideal = reduced * (1 - k1 * r2 - camera.distortion.k2 * r2**2)[..., None]
    got = result()
    points = intersected(camera.c + error["c_mm"], ideal, position, matrix, got.positions[p])
    formulas.assert_scatter(points - got.positions[p], got.covariance[p])


def test_mount_errors_do_not_average_out():
    # A boresight error moves all rays of a point alike: treated as independent, it would shrink with their number.
    free = eqx.tree_at(lambda b: b.priors.mounts["imu"], uncertain()[0], Mount(*[blocks.FIXED] * 3))
    without = georeference(free)
    assert (result().point_sigma > without.point_sigma).all()
    assert (result().exterior_sigma[:, 3:] > without.exterior_sigma[:, 3:]).all()
    np.testing.assert_allclose(
        result().exterior_sigma[:, 3:] ** 2 - without.exterior_sigma[:, 3:] ** 2,
        np.broadcast_to(BORESIGHT_SIGMA**2, (10, 3)),
        rtol=0.05,
    )


def test_only_images_with_both_sensors_and_points_they_determine():
    block, truth = known("everything")
    got = georeference(block)
    assert got.images == tuple(block.images[i] for i in block.attitudes.image)
    rays = [block.points[p] for i, p in zip(block.image_points.image, block.image_points.point, strict=True)
            if block.images[i] in got.images]  # fmt: skip
    assert set(got.points) == {p for p in block.points if rays.count(p) >= 2}
    place = [block.points.index(p) for p in got.points]
    off = np.abs(got.positions - truth.points[place]) / got.point_sigma
    assert off.max() < 5 and np.sqrt((off**2).mean()) > 0.5

    surveyed = {(block.points[w], a): v for r in (block.control, block.fixed, block.check)
                for w, a, v in zip(r.who, r.axis, np.asarray(r.value), strict=True)}  # fmt: skip
    d = got.discrepancies
    assert {(got.points[w], a) for w, a in zip(d.who, d.axis, strict=True)} == {
        k for k in surveyed if k[0] in got.points
    }
    expected = [surveyed[got.points[w], a] - got.positions[w, a] for w, a in zip(d.who, d.axis, strict=True)]
    np.testing.assert_allclose(d.value, expected, rtol=0, atol=1e-9)


def test_refraction_and_curvature_of_the_block_are_applied():
    block = uncertain()[0]
    bent = georeference(dataclasses.replace(block, corrections=Corrections(curvature=True)))
    lowered = bent.positions - result().positions
    # Curvature lowers what a straight ray aims at: the true point is higher, by d^2 / 2R of some 500 m: 2 cm.
    assert 0.002 < np.median(lowered[:, 2]) < 0.1


def test_no_sensors():
    with pytest.raises(BlockError, match="no image has both a complete station and an attitude"):
        georeference(without_attitudes(uncertain()[0]))
