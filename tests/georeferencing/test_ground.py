"""Image rays to the ground: against NumPy, and in the implicit derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxphoto.camera import Brown, InteriorOrientation
from jaxphoto.collinearity import ExteriorOrientation, project
from jaxphoto.georeferencing import Corrections, Surface, apparent_point, ground_point
from jaxphoto.rotation import matrix_from_omega_phi_kappa
from tests import formulas
from tests.derivatives import check_derivatives, compiled

CAMERA = InteriorOrientation(35.1, 0.05, -0.08, Brown(k1=-9e-5))
POSITION, ANGLES = np.array([300.0, -200.0, 1100.0]), np.array([0.05, -0.12, 2.0])
XY = np.array([11.0, -7.5])
EXTERIOR = ExteriorOrientation(POSITION, formulas.camera_from_object(*ANGLES))
BOTH = Corrections(refraction=True, curvature=True)


def hills(x, y):
    return 80 + 60 * jnp.sin(x / 150) * jnp.cos(y / 110) + 0.1 * x


HILLS = Surface(hills, -200.0, 400.0)


def rays(interior, matrices, xy):
    """Directions in object space in NumPy: c, xp, yp, k1 by column, rotations and image coordinates by row."""
    c, xp, yp, k1 = np.atleast_2d(interior).T
    reduced = xy - np.column_stack([xp, yp])
    ideal = reduced * (1 - k1 * (reduced**2).sum(1))[:, None]
    return np.einsum("nji,nj->ni", matrices, np.column_stack([ideal, -np.broadcast_to(c, len(ideal))]))


RAY = rays([35.1, 0.05, -0.08, -9e-5], EXTERIOR.camera_from_object[None], XY[None])[0]
on_plane = compiled(lambda e, xy, z: ground_point(CAMERA, e, xy, z))
on_hills = compiled(lambda e, xy: ground_point(CAMERA, e, xy, HILLS))


def test_point_on_a_plane_agrees_with_numpy():
    point, met = on_plane(EXTERIOR, XY, 55.0)
    np.testing.assert_allclose(point, POSITION + RAY * (55.0 - POSITION[2]) / RAY[2], rtol=0, atol=1e-10)
    assert met


def test_point_on_a_surface_is_where_numpy_bisects_the_ray():
    point, met = on_hills(EXTERIOR, XY)
    near, far = 0.0, 40.0
    for _ in range(80):
        middle = 0.5 * (near + far)
        x, y, z = POSITION + middle * RAY
        above = z > 80 + 60 * np.sin(x / 150) * np.cos(y / 110) + 0.1 * x
        near, far = (middle, far) if above else (near, middle)
    np.testing.assert_allclose(point, POSITION + near * RAY, rtol=0, atol=1e-8)
    assert met


@pytest.mark.parametrize("corrections", [Corrections(), BOTH])
@pytest.mark.parametrize("ground", [12.0, HILLS])
def test_ground_point_is_imaged_where_it_came_from(ground, corrections):
    @compiled
    def there_and_back(xy):
        point, met = ground_point(CAMERA, EXTERIOR, xy, ground, corrections)
        return project(CAMERA, EXTERIOR, apparent_point(POSITION, point, corrections)), point, met

    xy, (x, y, z), met = there_and_back(XY)
    assert met
    np.testing.assert_allclose(xy, XY, rtol=0, atol=1e-10)
    assert z == pytest.approx(12.0 if ground == 12.0 else float(hills(x, y)), abs=1e-8)


def test_rays_that_miss_say_so():
    upward = ExteriorOrientation(POSITION, formulas.camera_from_object(np.pi, 0.0, 0.0))
    level = ExteriorOrientation(POSITION, np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]))
    principal = np.array([0.05, -0.08])
    for image in (upward, level):
        assert not on_plane(image, principal, 0.0)[1]
        assert not on_hills(image, principal)[1]
    assert on_plane(upward, principal, 2000.0)[1]
    below = ExteriorOrientation(POSITION * [1, 1, 0], EXTERIOR.camera_from_object)
    assert not on_plane(below, XY, 55.0)[1]
    assert not on_hills(ExteriorOrientation(POSITION - [0, 0, 1400], EXTERIOR.camera_from_object), XY)[1]
    # A surface that leaves the heights it was said to have, and one that ends.
    ends = Surface(lambda x, y: jnp.where(x > 1e4, 0.0, jnp.nan), -10.0, 10.0)
    for surface in (Surface(hills, 300.0, 400.0), ends):
        assert not compiled(lambda xy, s=surface: ground_point(CAMERA, EXTERIOR, xy, s)[1])(XY)


def test_steep_and_cornered_ground_is_found():
    # From where Newton alone would leave the waves, and over a corner where the slope jumps.
    waves = Surface(lambda x, y: 60 * jnp.sin(x / 15), -60.0, 60.0)
    ridge = Surface(lambda x, y: 100 - 0.2 * jnp.abs(x - 1500), -5000.0, 100.0)
    oblique = ExteriorOrientation(np.array([0.0, 0, 900]), formulas.camera_from_object(0.0, -0.9, 0.0))
    image = np.column_stack([np.linspace(-16, 16, 33), np.full(33, 3.0)])
    for surface in (waves, ridge):

        @compiled
        def found(images, s=surface):
            points, met = jax.vmap(lambda xy: ground_point(CAMERA, oblique, xy, s))(images)
            return points, met, jax.vmap(lambda p: s.height(p[0], p[1]))(points)

        points, met, heights = found(image)
        assert met.all()
        np.testing.assert_allclose(points[:, 2], heights, rtol=0, atol=1e-6)


def on_ground(position, angles, interior, xy, height):
    """Everything in units of the order of one: kilometres, mm, 1e-4."""
    camera = InteriorOrientation(interior[0], interior[1], interior[2], Brown(k1=1e-4 * interior[3]))
    exterior = ExteriorOrientation(1000 * position, matrix_from_omega_phi_kappa(angles))
    plane = ground_point(camera, exterior, xy, 1000 * height, BOTH)[0]
    raised = Surface(lambda x, y: hills(x, y) + 1000 * height, -500.0, 700.0)
    surface = ground_point(camera, exterior, xy, raised)[0]
    return plane / 1000, surface / 1000


def test_derivatives_on_plane_and_surface():
    rng = np.random.default_rng(4)
    n = 6
    position = rng.uniform(-1, 1, (n, 3)) * [0.3, 0.3, 0.1] + [0, 0, 1.1]
    angles = rng.uniform(-1, 1, (n, 3)) * [0.2, 0.2, 3]
    angles[-1] = 0.0
    interior = np.tile([35.1, 0.05, -0.08, -0.9], (n, 1))
    xy = rng.uniform(-1, 1, (n, 2)) * [15, 10]
    check_derivatives(on_ground, position, angles, interior, xy, 0.05 * rng.normal(size=n))
