"""Surface models, their holes and shading, and orthophotos, against independent computation."""

import numpy as np
import pytest
from scipy.ndimage import label
from scipy.stats import binned_statistic_2d

from jaxphoto import Brown, ExteriorOrientation, InputError, InteriorOrientation, Sensor
from jaxphoto.camera import BundlerRadial
from jaxphoto.georeferencing import Corrections
from jaxphoto.lidar.raster import Raster, filled, hidden, hillshade, orthophoto, surface_model
from tests.checked_types import unchecked
from tests.formulas import camera_from_object
from tests.lidar.photographs import rendered

SENSOR = Sensor(360, 240, 0.1)
INTERIOR = InteriorOrientation(35.0, 0.3, -0.2, Brown(k1=-8e-5, k2=1e-8))
POSITION, ANGLES = np.array([20.0, -10.0, 500.0]), np.array([0.05, -0.08, 0.7])
EXTERIOR = ExteriorOrientation.from_angles(POSITION, ANGLES)


def points(n=20_000, seed=3):
    rng = np.random.default_rng(seed)
    return rng.uniform([-37.3, 1000.1, -5.0], [61.9, 1049.7, 80.0], (n, 3))


@pytest.mark.parametrize(("statistic", "name"), [("highest", "max"), ("mean", "mean"), ("lowest", "min")])
def test_cells_hold_the_statistic_of_their_points(statistic, name):
    xyz = points(3000)
    cell = 2.5
    raster = surface_model(np.array_split(xyz, 7), [xyz.min(axis=0)[:2], xyz.max(axis=0)[:2]], cell, statistic)
    (west, south), (east, north) = raster.extent
    assert west % cell == south % cell == 0
    edges = np.arange(west, east + cell / 2, cell), np.arange(south, north + cell / 2, cell)
    expected = binned_statistic_2d(xyz[:, 0], xyz[:, 1], xyz[:, 2], name, bins=edges).statistic.T[::-1]
    assert np.isnan(expected).any()
    np.testing.assert_allclose(raster.heights, expected, rtol=0, atol=1e-12)
    there = raster.heights.ravel() == raster.heights.ravel()
    for x, y, z in raster.centres()[there][::50]:
        inside = np.abs(xyz[:, :2] - [x, y]).max(axis=1) < cell / 2
        assert z == pytest.approx(getattr(np, {"max": "max", "min": "min"}.get(name, "mean"))(xyz[inside, 2]))


def test_empty_margins_and_points_outside_are_left_out():
    xyz = np.array([[10.0, 20.0, 1.0], [11.5, 22.2, 2.0], [99.0, 20.0, 3.0]])
    raster = surface_model([xyz], [[0.0, 0.0], [50.0, 50.0]], 1.0)
    assert (raster.west, raster.north, raster.heights.shape) == (10.0, 23.0, (3, 2))
    np.testing.assert_array_equal(raster.heights[[2, 0], [0, 1]], [1.0, 2.0])


def test_what_cannot_be_gridded_is_said():
    xyz = points(10)
    ends = [xyz.min(axis=0)[:2], xyz.max(axis=0)[:2]]
    for cell, word in ((0.0, "positive"), (-1.0, "positive"), (float("nan"), "positive"), (1e-4, "too many")):
        with pytest.raises(InputError, match=word):
            surface_model([xyz], ends, cell)
    with pytest.raises(InputError, match="no point"):
        surface_model([xyz + 1e4], ends, 1.0)
    with pytest.raises(InputError, match="median"), unchecked():
        surface_model([xyz], ends, 1.0, "median")


def test_holes_are_closed_whole_or_not_at_all():
    rng = np.random.default_rng(5)
    heights = rng.normal(0.0, 1.0, (40, 60))
    heights[3, 3] = heights[10:12, 20:22] = np.nan
    heights[20:31, 20:31] = np.nan
    heights[20:31, 31] = np.nan
    heights[0:2, 50] = np.nan
    raster = Raster(heights, 0.0, 80.0, 2.0)
    # Of 2 x 2 cells every one is 2 m from a height; of 11 x 12 the middle is 12 m; one at the edge is no hole.
    small = filled(raster, 2.0).heights
    assert not np.isnan(small[[3, 10, 11], [3, 20, 21]]).any()
    assert np.isnan(small[20:31, 20:32]).all()
    assert np.isnan(small[0:2, 50]).all()
    np.testing.assert_array_equal(filled(raster, 1.9).heights, heights)
    np.testing.assert_array_equal(filled(raster, 11.9).heights[20:31, 20:32], heights[20:31, 20:32])
    wide = filled(raster, 12.0).heights
    assert label(np.isnan(wide))[1] == 1
    # Inverse squares of the distance, in cells, over all heights within reach.
    for row, column, reach, values in ((3, 3, 1, small), (11, 20, 1, small), (25, 25, 6, wide)):
        r, c = np.indices(heights.shape)
        square = (r - row) ** 2 + (c - column) ** 2
        near = (square <= reach**2) & ~np.isnan(heights)
        assert values[row, column] == pytest.approx(np.average(heights[near], weights=1 / square[near]), abs=1e-12)
    there = ~np.isnan(heights)
    np.testing.assert_array_equal(wide[there], heights[there])


def test_shading_is_that_of_the_plane():
    x, y = np.meshgrid(np.arange(20) * 2.0, -np.arange(30) * 2.0)
    heights = 0.3 * x - 0.2 * y
    heights[10, 10] = np.nan
    shade = hillshade(Raster(heights, 0.0, 0.0, 2.0), 300.0, 35.0)
    azimuth, altitude = np.deg2rad([300.0, 35.0])
    sun = np.array([np.sin(azimuth) * np.cos(altitude), np.cos(azimuth) * np.cos(altitude), np.sin(altitude)])
    normal = np.array([-0.3, 0.2, 1.0]) / np.linalg.norm([-0.3, 0.2, 1.0])
    missing = np.zeros(heights.shape, bool)
    missing[9:12, 10] = missing[10, 9:12] = True
    np.testing.assert_array_equal(np.isnan(shade), missing)
    np.testing.assert_allclose(shade[~missing], sun @ normal, atol=1e-12)


def texture(x, y):
    """Three bands of a ground whose brightness changes over some 25 pixels of the photograph."""
    return np.stack([100 + 60 * np.sin(x / 9 + k) * np.cos(y / 11) for k in range(3)])


def ground(x, y):
    return 0.05 * x - 0.08 * y + 3.0


PHOTOGRAPH = rendered(SENSOR, INTERIOR, POSITION, ANGLES, ground, texture)


def plane_raster(cell=3.0, n=140):
    x = (np.arange(n) + 0.5) * cell - n * cell / 2
    return Raster(ground(x[None, :], -x[:, None]), -n * cell / 2, n * cell / 2, cell)


def imaged(xyz):
    """Ideal image coordinates by the textbook's quotients."""
    u, v, w = camera_from_object(*ANGLES) @ (xyz - POSITION).T
    return -INTERIOR.c * u / w, -INTERIOR.c * v / w


def test_orthophoto_is_the_texture_of_the_ground():
    raster = plane_raster()
    picture = orthophoto(raster, PHOTOGRAPH, SENSOR, INTERIOR, EXTERIOR)
    centres = raster.centres()
    truth = texture(centres[:, 0], centres[:, 1]).reshape(3, *raster.heights.shape)
    seen = picture.seen
    assert 0.5 < seen.mean() < 0.99
    # A pixel is 1.4 m; the bilinear error is below p^2 / 8 (f_xx + f_yy), some 60 / 81 each.
    assert np.abs(picture.pixels - truth)[:, seen].max() < 0.6
    assert not picture.pixels[:, ~seen].any()
    # Seen is all that lies in the format: by ideal coordinates, some pixels of distortion off its edge.
    x, y = imaged(centres)
    margin = 1.5
    surely = (np.abs(x) < 18 - margin) & (np.abs(y) < 12 - margin)
    never = (np.abs(x) > 18 + margin) | (np.abs(y) > 12 + margin)
    assert seen.ravel()[surely].all() and not seen.ravel()[never].any()


def test_orthophoto_of_whole_numbers_in_another_frame():
    """Whole pixels are rounded, and the raster's system may be another than the block's."""
    raster = plane_raster(6.0, 60)
    photograph = np.rint(PHOTOGRAPH).astype(np.uint8)
    shift = np.array([5e5, 7e6, 10.0])
    moved = Raster(raster.heights + shift[2], raster.west + shift[0], raster.north + shift[1], raster.cell_m)
    here = orthophoto(raster, photograph, SENSOR, INTERIOR, EXTERIOR)
    there = orthophoto(
        moved, photograph, SENSOR, INTERIOR, EXTERIOR, object_from_map=lambda xyz: xyz - shift,
        map_from_object=lambda xyz: xyz + shift,
    )  # fmt: skip
    assert here.pixels.dtype == np.uint8
    np.testing.assert_array_equal(here.seen, there.seen)
    assert np.abs(here.pixels.astype(int) - there.pixels).max() <= 1
    truth = texture(*raster.centres()[:, :2].T).reshape(3, *raster.heights.shape)
    assert np.abs(here.pixels - truth)[:, here.seen].max() < 0.6 + 1.0


def test_corrections_move_where_a_cell_is_looked_up():
    raster = plane_raster(6.0, 60)
    plain = orthophoto(raster, PHOTOGRAPH, SENSOR, INTERIOR, EXTERIOR)
    bent = orthophoto(
        raster, PHOTOGRAPH, SENSOR, INTERIOR, EXTERIOR, corrections=Corrections(curvature=True, refraction=True)
    )
    both = plain.seen & bent.seen
    assert 0 < np.abs(plain.pixels - bent.pixels)[:, both].max() < 0.1


def test_behind_the_camera_and_beyond_a_fold_nothing_is_seen():
    raster = plane_raster(20.0, 200)
    up = ExteriorOrientation.from_angles(POSITION, np.array([np.pi, 0.0, 0.0]))
    photograph = np.ones((1, SENSOR.height_px, SENSOR.width_px))
    assert not orthophoto(raster, photograph, SENSOR, INTERIOR, up).seen.any()
    # Distortions that fold: r (1 - f r^2) has its greatest value 2 / 3 r0 at r0 = 1 / sqrt(3 f). That of Brown is a map
    # of measured radii to ideal ones, that of Bundler one of ideal ones (over c) to measured ones.
    greatest_ideal = {
        InteriorOrientation(35.0, 0.0, 0.0, Brown(k1=9e-4)): 2 / 3 / np.sqrt(3 * 9e-4),
        InteriorOrientation(35.0, 0.0, 0.0, BundlerRadial(k1=-0.9, k2=0.0)): 35.0 / np.sqrt(3 * 0.9),
    }
    for folding, greatest in greatest_ideal.items():
        seen = orthophoto(raster, photograph, SENSOR, folding, EXTERIOR).seen.ravel()
        x, y = imaged(raster.centres())
        assert 0.9 * greatest < np.hypot(x, y)[seen].max() < greatest


def box_raster(cell=1.0):
    x = (np.arange(160) + 0.5) * cell - 80
    inside = (np.abs(x[None, :] - 30) < 10) & (np.abs(-x[:, None] + 5) < 15)
    heights = np.where(inside, 20.0, 0.0)
    heights[:, 5] = np.nan
    return Raster(heights, -80.0, 80.0, cell)


@pytest.mark.parametrize("camera", [(-60.0, 10.0, 90.0), (200.0, -150.0, 300.0), (30.0, -5.0, 100.0)])
def test_a_box_hides_what_lies_behind_it(camera):
    """Against the line of sight, sampled finely, through the box."""
    raster, camera = box_raster(), np.array(camera)
    centres = raster.centres()
    centres = centres[~np.isnan(centres[:, 2])][::5]
    found = hidden(raster, centres, camera)

    def blocked(margin):
        """By a box that is larger by `margin` than the true one."""
        t = np.linspace(0, 1, 2000)[1:, None]
        result = np.zeros(len(centres), bool)
        for k, point in enumerate(centres):
            line = point + t * (camera - point)
            into = (np.abs(line[:, 0] - 30) < 10 + margin) & (np.abs(line[:, 1] + 5) < 15 + margin)
            result[k] = (into & (line[:, 2] < 20 - 1e-6 + margin)).any()
        return result

    low = centres[:, 2] == 0
    # The surface joins the roof and the ground beside it within one cell.
    assert found[low & blocked(-1.0)].all()
    assert not found[low & ~blocked(1.0)].any()
    assert not found[~low].any()
    if camera[0] != 30.0:
        assert found.sum() > 60


def test_a_rough_plane_does_not_hide_itself_from_above():
    raster = plane_raster(1.0, 60)
    assert not hidden(raster, raster.centres(), np.array([300.0, 100.0, 400.0])).any()
