"""Rolling shutter: against a projection that looks for the true time of every row, and recovered with its sigma."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from jaxphoto import FIXED, FREE, ExteriorOrientation, Outcome, Weighted, adjust, correlated, covariance
from jaxphoto.block import Datum
from jaxphoto.camera import ImageMotion, RollingShutter, RowMotion
from jaxphoto.collinearity import image_residual
from jaxphoto.errors import BlockError, DatumError
from jaxphoto.io import read_block, write_block
from jaxphoto.observations import CameraPositions, ControlCoordinates
from jaxphoto.rotation import small_rotation
from tests.blocks import BROWN, SENSOR, simulated
from tests.derivatives import check_derivatives, compiled

READOUT_MS = 60.0
"""The block of the tests flies at 60 m/s, 1000 m high."""


def by_bisection(interior, position, camera_from_object, motion, readout_ms, point):
    """Where a point is measured: the time at which its row is exposed, by bisection, in SciPy's rotations."""
    k1, k2 = (float(v) for v in (interior.distortion.k1, interior.distortion.k2))

    def seen(t):
        centre = position + camera_from_object.T @ motion[:3] * t
        u, v, w = Rotation.from_rotvec(-motion[3:] * t).as_matrix() @ camera_from_object @ (point - centre)
        ideal = np.array([u, v]) * -float(interior.c) / w
        r = np.hypot(*ideal)
        # The measured radius of an ideal one: ideal = measured (1 - k1 r^2 - k2 r^4).
        measured = brentq(lambda m: m * (1 - k1 * m**2 - k2 * m**4) - r, 0.0, 1.3 * r + 1e-9, xtol=1e-13)
        return ideal * measured / r + [float(interior.xp), float(interior.yp)]

    row = lambda t: t + 1e-3 * readout_ms * seen(t)[1] / SENSOR.height_mm  # noqa: E731
    return seen(brentq(row, -1e-3 * abs(readout_ms), 1e-3 * abs(readout_ms), xtol=1e-14))


def motions_of(n: int, seed: int = 3) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.column_stack([rng.normal([0, 60, 0], 8, (n, 3)), rng.normal(0, 0.03, (n, 3))])


@pytest.mark.parametrize("readout_ms", [READOUT_MS, -READOUT_MS])
def test_the_true_time_of_every_row_leaves_no_residual(readout_ms):
    position, turn = np.array([10.0, -20.0, 900.0]), np.array([0.05, -0.03, 1.0])
    rotation = np.asarray(small_rotation(jnp.asarray(turn)))
    motion = motions_of(1)[0]
    points = np.array([[100.0, 50.0, 20.0], [-250.0, 200.0, 80.0], [10.0, -150.0, 0.0]])
    rows = RowMotion(1e-3 * readout_ms / SENSOR.height_mm, *motion)
    bent = dataclasses.replace(BROWN, rows=rows)
    exterior = ExteriorOrientation(position, rotation)
    at = compiled(lambda point, xy: image_residual(bent, exterior, point, xy))
    still = compiled(lambda point, xy: image_residual(BROWN, exterior, point, xy))
    for point in points:
        xy = by_bisection(BROWN, position, rotation, motion, readout_ms, point)
        assert np.abs(at(point, xy)).max() < 1e-9
        assert np.abs(still(point, xy)).max() > 0.005


def test_derivatives():
    rng = np.random.default_rng(1)
    n = 3

    def residual(turn, position, motion, time, point, y):
        rows = RowMotion(0.05 * time, *motion)
        exterior = ExteriorOrientation(position + jnp.array([0.0, 0, 8.0]), small_rotation(turn))
        return image_residual(dataclasses.replace(BROWN, rows=rows), exterior, point, jnp.array([3.0, 10.0 * y]))

    motion = np.concatenate([rng.normal(size=(n - 1, 6)), np.zeros((1, 6))])
    check_derivatives(
        residual, rng.normal(0, 0.1, (n, 3)), rng.normal(0, 0.3, (n, 3)), motion, np.array([0.5, 0.0, 0.3]),
        rng.normal(size=(n, 3)), np.array([0.4, -0.7, 0.2]),
    )  # fmt: skip


@pytest.fixture(scope="module")
def rolling():
    """The crossing strips, seen row by row by a camera whose motions are known."""
    block, truth = simulated("cross")
    rows, motions = block.image_points, motions_of(len(block.images))
    position, rotation = (np.asarray(v) for v in (truth.exterior.position, truth.exterior.camera_from_object))
    moved = np.zeros((len(rows), 2))
    for k, (i, p) in enumerate(zip(rows.image, rows.point, strict=True)):
        at = [
            by_bisection(BROWN, position[i], rotation[i], motions[i], readout, truth.points[p])
            for readout in (READOUT_MS, 1e-9)
        ]
        moved[k] = at[0] - at[1]
    xy = np.asarray(rows.xy) + moved
    return dataclasses.replace(block, image_points=dataclasses.replace(rows, xy=xy)), motions


def with_shutter(block, motions, readout=FREE, velocity=FIXED, rate=FIXED):
    own = {name: ImageMotion(m[:3], m[3:]) for name, m in zip(block.images, motions, strict=True)}
    more = {"shutters": {"one": RollingShutter(np.float64(0.0))}, "motions": own}
    known = lambda value, sigma: FIXED if sigma == FIXED else Weighted(value, sigma)  # noqa: E731
    of_each = {name: ImageMotion(known(m.velocity, velocity), known(m.rate, rate)) for name, m in own.items()}
    priors = {"shutters": {"one": RollingShutter(readout)}, "motions": of_each}
    start = dataclasses.replace(block.start.unknowns, more=more)
    return dataclasses.replace(
        block,
        start=dataclasses.replace(block.start, unknowns=start),
        priors=dataclasses.replace(block.priors, more=priors),
    )


def sigmas(found):
    return dict(zip(found.structure.labels, np.asarray(covariance(found).shared_sigma), strict=True))


def check(found, share=0.1):
    """Readout and camera within three of their sigmas, which are small."""
    own = sigmas(found)
    sigma = own["shutters[one].readout_ms"]
    assert found.outcome is Outcome.CONVERGED
    assert 0.9 < found.sigma0 < 1.1
    readout = float(found.unknowns.more["shutters"]["one"].readout)
    assert abs(readout - READOUT_MS) < 3 * sigma < share * READOUT_MS
    for field, label in {"c": "c_mm", "xp": "xp_mm", "yp": "yp_mm"}.items():
        off = float(getattr(found.unknowns.interior["one"], field)) - float(getattr(BROWN, field))
        assert abs(off) < 3 * own[f"interior[one].{label}"]


def test_the_readout_is_recovered(rolling):
    check(adjust(with_shutter(*rolling)))


def test_without_the_readout_the_block_does_not_fit(rolling):
    assert adjust(rolling[0]).sigma0 > 4


@pytest.mark.slow
def test_motions_are_unknowns_by_image_where_they_are_weighted(rolling):
    block, motions = rolling
    off = motions + np.random.default_rng(8).normal(size=motions.shape) * [0.5, 0.5, 0.5, 0.01, 0.01, 0.01]
    found = adjust(with_shutter(block, off, FREE, np.full(3, 0.5), np.full(3, 0.01)))
    check(found, 0.2)
    rates = np.array([np.asarray(own.rate) for own in found.unknowns.more["motions"].values()])
    before, after = (np.sqrt(np.mean((r - motions[:, 3:]) ** 2)) for r in (off[:, 3:], rates))
    assert after < 0.8 * before


def test_what_it_cannot_do_is_refused(rolling):
    block, none = with_shutter(*rolling), ControlCoordinates.none()
    loose = dataclasses.replace(block, control=none, stations=CameraPositions.none(), datum=Datum("inner", "points"))
    with pytest.raises(DatumError, match="needs the scale of the block"):
        adjust(loose)
    rows = block.image_points.take(np.arange(4))
    joined = correlated(rows, [range(4)], np.eye(8)[None] * 0.004**2)
    with pytest.raises(BlockError, match="remove shutters, motions"):
        adjust(block, more=(joined,))


def test_it_comes_back_from_a_block_folder(rolling, tmp_path):
    block = with_shutter(*rolling, Weighted(30.0, 2.0))
    write_block(block, tmp_path / "block")
    again = read_block(tmp_path / "block")
    known = again.priors.more["shutters"]["one"].readout
    assert (float(known.value), float(known.sigma)) == (30.0, 2.0)
    for name, own in block.start.unknowns.more["motions"].items():
        np.testing.assert_allclose(again.start.unknowns.more["motions"][name].velocity, own.velocity, rtol=1e-12)
        np.testing.assert_allclose(again.start.unknowns.more["motions"][name].rate, own.rate, rtol=1e-12)
