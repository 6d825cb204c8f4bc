import numpy as np
import pytest

from jaxphoto.camera import Brown, InteriorOrientation
from jaxphoto.errors import BlockError
from jaxphoto.initial.resection import resect, three_point_resections
from tests.formulas import camera_from_object, random_rotations
from tests.initial.scene import K1, C, ideal_images, measured

IDEAL = InteriorOrientation(C)
POSITION = np.array([6.5e5, 7.2e6, 900.0])


def seen(matrix, xy, depth):
    """Object points with these ideal image coordinates at these depths."""
    return POSITION + np.column_stack([xy / C, -np.ones(len(xy))]) * np.asarray(depth)[:, None] @ matrix


def spread(n, seed=0):
    """Image points over the whole format: a corner each, then at random."""
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [15.0, 10.0]
    more = np.random.default_rng(seed).uniform(-1, 1, (n, 2)) * [17, 11]
    return np.concatenate([corners + more[:4] / 8, more[4:]])


def assert_is(exterior, matrix, position=POSITION, turn=1e-7, metres=1e-4):
    np.testing.assert_allclose(exterior.camera_from_object, matrix, rtol=0, atol=turn)
    np.testing.assert_allclose(exterior.position, position, rtol=0, atol=metres)


@pytest.mark.parametrize("n", [4, 5, 12, 60])
@pytest.mark.parametrize("seed", range(5))
def test_any_attitude_from_points_in_space(n, seed):
    matrix = random_rotations(np.random.default_rng(seed), 1)[0]
    xy = spread(n, seed)
    points = seen(matrix, xy, np.random.default_rng(seed).uniform(600, 1200, n))
    assert_is(resect(IDEAL, xy, points), matrix)


@pytest.mark.parametrize("n", [4, 20])
@pytest.mark.parametrize(
    "angles", [(0, 0, 0), (0, 0, 2.5), (0.02, -0.03, 1.0), (0.6, 0.5, -2.0), (1.2, 0, 0.3), (0, np.pi / 2, 0.3)]
)
def test_any_attitude_from_points_in_a_plane(n, angles):
    matrix = camera_from_object(*angles)
    xy = spread(n, 3)
    rays = seen(matrix, xy, np.ones(n)) - POSITION
    normal = matrix.T @ np.array([0.2, -0.1, 1.0]) if angles[0] != 0 else matrix[2]
    points = POSITION + rays * (-900 / (rays @ normal))[:, None]
    assert np.linalg.svd(points - points.mean(0))[1][2] < 1e-6, "not a plane"
    assert_is(resect(IDEAL, xy, points), matrix)


def test_vertical_photograph_of_a_square():
    # Every formula of Grunert's that divides by cos(gamma) - v cos(alpha) breaks down here.
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 100.0
    exterior = resect(IDEAL, 35 * square[:, :2] / 300, square)
    assert_is(exterior, np.eye(3), [0, 0, 300.0])


def test_with_distortion_and_principal_point():
    interior = InteriorOrientation(C, 0.3, -0.2, Brown(k1=K1))
    matrix, xy = camera_from_object(0.1, -0.2, 1.0), spread(10)
    points = seen(matrix, xy, np.linspace(800, 1000, 10))
    assert_is(resect(interior, np.add(measured(xy), [0.3, -0.2]), points), matrix)


def test_a_rough_interior_orientation_is_enough():
    # Distortion unknown (0.7 mm in the corner, 90 px) and c 3 % wrong: half a degree and 5 % of the height will do.
    matrix, xy = camera_from_object(0.3, -0.2, 1.0), spread(20)
    points = seen(matrix, xy, np.linspace(800, 1000, 20))
    exterior = resect(InteriorOrientation(1.03 * C), measured(xy), points)
    assert np.abs(np.linalg.norm(measured(xy) - xy, axis=1)).max() > 0.3
    assert_is(exterior, matrix, turn=0.02, metres=60)


def test_measuring_errors_stay_small():
    rng = np.random.default_rng(5)
    matrix, xy = camera_from_object(0.02, 0.01, 0.4), spread(25)
    points = seen(matrix, xy, rng.uniform(800, 1000, 25))
    exterior = resect(IDEAL, xy + 0.004 * rng.normal(size=xy.shape), points)
    # One pixel of 8 um is 0.2 m on the ground; the error must be of that size, and cannot be nothing.
    error = np.linalg.norm(exterior.position - POSITION)
    assert 1e-4 < error < 1.0


def test_the_outermost_points_may_all_be_wrong():
    # The largest triangles are made of them; random triangles and Cauchy's weights have to save the image.
    matrix, xy = camera_from_object(0.1, -0.2, 1.0), spread(60)
    points = seen(matrix, xy, np.random.default_rng(8).uniform(700, 1000, 60))
    outermost = np.argsort(-np.linalg.norm(xy, axis=1))[:10]
    points[outermost] += np.random.default_rng(9).uniform(-300, 300, (10, 3))
    assert_is(resect(IDEAL, xy, points), matrix, turn=2e-3, metres=2.0)


def test_three_points_give_the_truth_among_up_to_four_solutions():
    matrix, xy = camera_from_object(0.5, -0.4, 1.0), spread(4)[:3]
    points = seen(matrix, xy, [700.0, 900, 1100])
    rays = np.column_stack([xy, -C * np.ones(3)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    positions, matrices = three_point_resections(rays[None], points[None])
    right = [ideal_images(p, m, points)[0] - xy for p, m in zip(positions, matrices, strict=True)]
    exact = [k for k, error in enumerate(right) if np.abs(error).max() < 1e-6]
    assert 1 <= len(exact) <= 4
    assert min(np.abs(matrices[k] - matrix).max() for k in exact) < 1e-8


@pytest.mark.parametrize("repeated", [0, 3])
def test_three_points_are_refused(repeated):
    xy = spread(4)[:3]
    points = seen(np.eye(3), xy, [700.0, 900, 1100])
    take = [0, 1, 2, 0, 1, 2][: 3 + repeated]
    with pytest.raises(BlockError, match=r"image DSC_7 sees 3 known points, and a resection needs 4.*images\.csv"):
        resect(IDEAL, xy[take], points[take], "DSC_7")


def test_points_on_a_line_are_refused():
    points = np.array([0.0, 0, 0]) + np.arange(6)[:, None] * [10.0, 5, 1]
    xy, _ = ideal_images(np.array([30.0, 10, 100]), np.eye(3), points)
    with pytest.raises(BlockError, match="known points of image DSC_7 lie on a line"):
        resect(IDEAL, xy, points, "DSC_7")


def test_points_that_belong_elsewhere_are_refused():
    rng = np.random.default_rng(7)
    xy, points = spread(30), rng.normal(size=(30, 3)) * 100
    with pytest.raises(BlockError, match="resection of image DSC_7 failed: no orientation fits"):
        resect(IDEAL, xy, points, "DSC_7")
