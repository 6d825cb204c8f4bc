"""Heights equal independent interpolations, have correct standard deviations, and are NaN where undetermined."""

from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial import ConvexHull, cKDTree
from scipy.stats import norm

from jaxphoto import InputError
from jaxphoto.cloud import Cloud
from jaxphoto.lidar import HeightFlag, HeightSettings, heights_at, index_cloud
from jaxphoto.lidar.heights import REFUSED, normal_equivalent
from jaxphoto.lidar.sight import surrounded
from tests.checked_types import unchecked
from tests.lidar.clouds import SURFACES, gable, ground, places_over, read_autzen
from tests.marks import slow_but

METHODS = ("plane", "local")
# Small horizontal errors, so that few points tell the surface and few programs are compiled.
EXACT = HeightSettings(sigma_z_m=0.05, sigma_xy_m=0.05)
ALL = HeightSettings(sigma_z_m=0.05, sigma_xy_m=0.05, refuse=HeightFlag.OK)


@pytest.fixture(scope="module")
def autzen(data_dir: Path) -> np.ndarray:
    return read_autzen(data_dir)


def neighbours(xyz: np.ndarray, places: np.ndarray, k: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distances and indices of the nearest, and where no two points contend for the last place."""
    distance, index = cKDTree(xyz[:, :2]).query(places, k=k + 1)
    return distance[:, :k], index[:, :k], distance[:, k] > distance[:, k - 1]


def test_plane_of_real_cloud_is_that_of_lstsq(autzen: np.ndarray) -> None:
    places = places_over(autzen)
    found = heights_at(index_cloud(autzen), places, "plane", EXACT)
    _, index, sole = neighbours(autzen, places, 8)
    told = np.flatnonzero(sole & np.isfinite(found.z))
    assert len(told) > 3000
    for k in told:
        near = autzen[index[k]]
        rows = np.column_stack([np.ones(8), near[:, :2] - places[k]])
        assert abs(np.linalg.lstsq(rows, near[:, 2])[0][0] - found.z[k]) < 1e-9


def test_a_place_is_surrounded_where_its_neighbours_hull_holds_it() -> None:
    """Against the hull's own equations; a laser point exactly at the place lies on no side and changes nothing."""
    rng = np.random.default_rng(8)
    told = []
    for _ in range(60):
        q = rng.normal(rng.normal(0, 0.7, 2), 1.0, (7, 2))
        inside = bool((ConvexHull(q).equations[:, 2] < 0).all())
        used, with_own = np.ones(7, bool), np.vstack([q, np.zeros((1, 2))])
        assert bool(surrounded(q, used)) == bool(surrounded(with_own, np.ones(8, bool))) == inside
        # Those that do not count are of no account.
        assert bool(surrounded(np.vstack([q, -q]), np.append(used, ~used))) == inside
        told.append(inside)
    assert 10 < sum(told) < 50
    on_the_rim = np.array([[1.0, 2.0], [-2.0, -4.0], [3.0, 1.0], [0.0, 0.0]])
    assert not surrounded(on_the_rim, np.ones(4, bool))
    assert not surrounded(np.zeros((1, 2)), np.ones(1, bool))


def test_a_height_at_a_laser_point_is_told() -> None:
    """By every method: at a point inside the cloud there is no edge."""
    xyz = ground(lambda x, y: 0.3 * x, 1.0, 0.05, 0.02, 40.0)
    inner = xyz[(np.abs(xyz[:, :2] - 20) < 12).all(axis=1)]
    for method in METHODS:
        assert not heights_at(Cloud(xyz), inner[:, :2], method, EXACT).flagged(HeightFlag.EDGE).mean() > 0.01


def test_local_is_a_weighted_quadratic() -> None:
    xyz = ground(lambda x, y: 2 * np.sin(x / 9) * np.cos(y / 11), 1.0, 0.02, 0.0, 40.0)
    places = np.random.default_rng(3).uniform(8, 32, (60, 2))
    found = heights_at(Cloud(xyz), places, "local", HeightSettings(sigma_z_m=0.02, sigma_xy_m=0.0))
    distance, index, _ = neighbours(xyz, places, 24)
    smooth = np.flatnonzero(found.flag == 0)
    assert len(smooth) > 50
    for k in smooth:
        x, y = (xyz[index[k], :2] - places[k]).T
        root = np.exp(-0.25 * (distance[k] / (0.5 * distance[k, -1])) ** 2)
        rows = root[:, None] * np.column_stack([np.ones(24), x, y, x**2, x * y, y**2])
        assert abs(np.linalg.lstsq(rows, root * xyz[index[k], 2])[0][0] - found.z[k]) < 1e-9


def test_what_the_lidar_has_in_common_is_added() -> None:
    grid = index_cloud(ground(SURFACES["plane"], 1.0, 0.15, 0.5, 60.0))
    places = np.random.default_rng(1).uniform(5, 55, (60, 2))
    one, both = (
        heights_at(grid, places, "plane", HeightSettings(sigma_xy_m=0.05, sigma_systematic_m=s)) for s in (0.0, 0.2)
    )
    np.testing.assert_allclose(both.sigma, np.hypot(one.sigma, 0.2), rtol=1e-12)


@pytest.mark.parametrize("mean", [0.0, 0.3, 1.0, 3.0, 40.0])
def test_equivalent_sigma_holds_95_percent(mean: float) -> None:
    bound = norm.ppf(0.975)
    held = brentq(lambda q: norm.cdf(q, mean) - norm.cdf(-q, mean) - 0.95, 0, mean + 10)
    np.testing.assert_allclose(normal_equivalent(-0.7 * mean, 0.7), 0.7 * held / bound, rtol=1e-9)
    np.testing.assert_allclose(normal_equivalent(mean, 0.0), mean / bound, rtol=1e-6, atol=1e-12)


def test_density_slope_and_roughness() -> None:
    height = lambda x, y: 0.3 * x - 0.4 * y  # noqa: E731
    found = heights_at(
        index_cloud(ground(height, 2.0, 0.1, 0.0, 100.0)),
        np.random.default_rng(1).uniform(5, 95, (1000, 2)),
        "plane",
        HeightSettings(sigma_z_m=0.1, sigma_xy_m=0.0),
    )
    assert np.mean(found.density) == pytest.approx(2.0, rel=0.05)
    assert np.mean(found.gradient, axis=0) == pytest.approx([0.3, -0.4], abs=0.005)
    assert np.median(found.slope) == pytest.approx(0.5, abs=0.02)
    assert np.sqrt(np.mean(found.roughness**2)) == pytest.approx(0.1, rel=0.03)


@pytest.mark.parametrize("method", METHODS)
def test_holes_and_edges_are_refused(method: str) -> None:
    xyz = ground(SURFACES["slope 20 deg"], 1.0, 0.05, 0.05, 100.0)
    # Water: nothing comes back.
    xyz = xyz[np.hypot(*(xyz[:, :2] - 50).T) > 12]
    rng = np.random.default_rng(4)
    angle, radius = rng.uniform(0, 2 * np.pi, 60), 10 * np.sqrt(rng.uniform(size=60))
    in_water = 50 + radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    settings = HeightSettings(sigma_z_m=0.05, sigma_xy_m=0.05)
    found = heights_at(Cloud(xyz), in_water, method, settings)
    assert np.isnan(found.z).all() and np.isnan(found.sigma).all()
    assert found.flagged(HeightFlag.HOLE | HeightFlag.EDGE).all()
    assert found.flagged(HeightFlag.HOLE)[radius < 6].all()
    outside = np.array([[-3.0, 50.0], [104.0, 20.0], [50.0, -30.0], [1e5, 1e5]])
    assert heights_at(Cloud(xyz), outside, method, settings).flagged(HeightFlag.EDGE | HeightFlag.HOLE).all()
    inside = rng.uniform(5, 30, (60, 2))
    assert (heights_at(Cloud(xyz), inside, method, settings).flag & int(REFUSED) == 0).mean() > 0.95


def test_walls_and_ridges_are_refused_and_their_sides_are_not() -> None:
    wall = lambda x, y: np.where(x < 50, 0.0, 6.0)  # noqa: E731
    settings = HeightSettings(sigma_z_m=0.02, sigma_xy_m=0.03)
    y = np.random.default_rng(5).uniform(20, 80, 60)
    for height, middle in ((wall, 50.0), (gable, 56.0)):
        cloud = Cloud(ground(height, 4.0, 0.02, 0.03, 100.0))
        at = heights_at(cloud, np.column_stack([np.full(60, middle), y]), "plane", settings)
        assert at.flagged(HeightFlag.BREAKLINE).mean() > 0.9
        assert np.isnan(at.z[at.flagged(HeightFlag.BREAKLINE)]).all()
        aside = heights_at(cloud, np.column_stack([np.full(60, middle + 4), y]), "plane", settings)
        assert np.isnan(aside.z).mean() < 0.05


def test_vegetation_is_refused() -> None:
    xyz = ground(SURFACES["plane"], 4.0, 0.1, 0.1, 60.0)
    places = np.random.default_rng(6).uniform([5, 5], [25, 55], (60, 2))
    settings = HeightSettings(sigma_z_m=0.1, sigma_xy_m=0.1)
    left = xyz[:, 0] < 30
    crown = np.where(left, np.random.default_rng(7).uniform(0, 8, len(xyz)), 0.0)
    clouds = {
        "rough": Cloud(xyz + np.column_stack([0 * crown, 0 * crown, crown])),
        "classes": Cloud(xyz, classification=np.where(left, 5, 2).astype(np.uint8)),
        "returns": Cloud(xyz, returns=np.column_stack([1 + 0 * left, 1 + left]).astype(np.uint8)),
    }
    for name, cloud in clouds.items():
        assert heights_at(cloud, places, "local", settings).flagged(HeightFlag.VEGETATION).mean() > 0.9, name
        assert np.isfinite(heights_at(cloud, places + np.array([30, 0]), "local", settings).z).mean() > 0.9, name


def test_few_points_and_bad_questions() -> None:
    three = Cloud(np.array([[0.0, 0, 1], [1, 0, 2], [0, 1, 3]]))
    for method in METHODS:
        found = heights_at(three, np.array([[0.2, 0.2]]), method, EXACT)
        assert np.isnan(found.z).all() and found.flag[0]
    line = Cloud(np.column_stack([np.arange(40.0), np.arange(40.0), np.zeros(40)]))
    for method in METHODS:
        assert heights_at(line, np.array([[20.2, 20.3]]), method, EXACT).flag[0]
    assert len(heights_at(three, np.zeros((0, 2)), "plane", EXACT)) == 0
    with pytest.raises(InputError, match="choose one of plane, local"), unchecked():
        heights_at(three, np.zeros((1, 2)), "kriging")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="two columns"), unchecked():
        heights_at(three, np.zeros((1, 3)))
    with pytest.raises(InputError, match="power is -1"):
        HeightSettings(power=-1.0)
    with pytest.raises(InputError, match="points is 2"):
        HeightSettings(points=2)


LIDARS = [(0.5, 0.15, 0.5), (4.0, 0.02, 0.05)]


@pytest.mark.parametrize("lidar", slow_but(LIDARS[:1], LIDARS), ids=str)
@pytest.mark.parametrize("method", METHODS)
def test_errors_are_within_the_standard_deviation(method: str, lidar: tuple[float, float, float]) -> None:
    density, sigma_z, sigma_xy = lidar
    settings = HeightSettings(sigma_z_m=sigma_z, sigma_xy_m=sigma_xy)
    within = {}
    for name, height in SURFACES.items():
        side = np.sqrt(20_000 / density)
        grid = index_cloud(ground(height, density, sigma_z, sigma_xy, side))
        places = np.random.default_rng(1).uniform(5, side - 5, (1500, 2))
        found = heights_at(grid, places, method, settings)
        told = np.isfinite(found.z)
        error = found.z[told] - height(*places[told].T)
        within[name] = np.mean(np.abs(error) <= 1.96 * found.sigma[told])
        assert told.mean() > (0.5 if name == "gable" else 0.97)
    # A surface by itself: what the local surface cannot tell, such as a ridge under noise, costs some hundredths.
    assert abs(np.mean(list(within.values())) - 0.95) < 0.02, within
    assert min(within.values()) > 0.92, within
    assert max(within.values()) < 0.98, within
