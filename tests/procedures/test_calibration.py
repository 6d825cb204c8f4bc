"""Calibration with a board: the truth of a simulated camera, the start, gross errors, circles."""

import jax
import numpy as np
import pytest

from jaxphoto import Brown, ExteriorOrientation, InputError, InteriorOrientation, Outcome, Sensor, Smac, Tables
from jaxphoto.camera import get_parameter, rebalance
from jaxphoto.procedures.calibration import (
    Board,
    Detection,
    calibrate,
    distortion_model,
    eccentricity,
    free_parameters,
    target_calibration,
)
from jaxphoto.procedures.calibration.start import flat_start, nearest_distortion, projections
from jaxphoto.procedures.calibration.target_calibration import added_sigma, eccentricities
from jaxphoto.report.photographs import findings
from tests.derivatives import compiled

SENSOR = Sensor(1280, 960, 0.0054)
WIDE = InteriorOrientation(3.1, 0.04, -0.03, Smac(k1=-0.028, k2=-0.0009, k3=-5e-5, p1=2e-4, p2=-3e-4))
SIGMA_PX = 0.05
# Beyond, the distortion of the simulation is not invertible.
_WITHIN = 0.48


def flat_board(diameter_m: float = 0.0) -> Board:
    row, column = np.divmod(np.arange(9 * 7), 9)
    xyz = np.stack([0.03 * column, -0.03 * row, 0.0 * row], axis=1)
    ids = tuple(f"r{r}c{c}" for r, c in zip(row, column, strict=True))
    return Board("board", ids, xyz, np.full(len(ids), diameter_m))


def views(board: Board, n: int) -> list[ExteriorOrientation]:
    """Cameras half a radian and more off the normal, on all sides, turned about their axes."""
    rng = np.random.default_rng(1)
    found = []
    for k in range(n):
        target = board.xyz_m.mean(axis=0) + np.array([*rng.uniform(-0.06, 0.06, 2), 0])
        slant, around = rng.uniform(0.3, 0.7), 2.4 * k
        away = np.array([np.sin(slant) * np.cos(around), np.sin(slant) * np.sin(around), np.cos(slant)])
        x = np.cross([0.0, 1.0, 0.0], away)
        x /= np.linalg.norm(x)
        c, s = np.cos(0.8 * k), np.sin(0.8 * k)
        turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        matrix = turn @ np.stack([x, np.cross(away, x), away])
        found.append(ExteriorOrientation(target + rng.uniform(0.16, 0.24) * away, matrix))  # type: ignore[arg-type]
    return found


def seen(board, exteriors, noise_px, seed=0, interior=WIDE) -> list[Detection]:
    rng = np.random.default_rng(seed)
    detections = []
    for k, exterior in enumerate(exteriors):
        n = len(board.points)
        place = np.tile(exterior.position, (n, 1)), np.tile(exterior.camera_from_object, (n, 1, 1))
        px = SENSOR.px_from_mm(projections(interior, *place, board.xyz_m))
        px += noise_px * rng.standard_normal(px.shape)
        half = np.array([SENSOR.width_px, SENSOR.height_px]) / 2
        point = np.flatnonzero((np.abs(px - half) < 2 * _WITHIN * half).all(axis=1))
        detections.append(Detection(f"i{k}", point, px[point], np.full((len(point), 2), noise_px)))
    return detections


@pytest.fixture(scope="module")
def simulated():
    board = flat_board()
    detections = seen(board, views(board, 12), SIGMA_PX)
    # Two blunders, one image of something else, one with hardly a target.
    spoilt = detections[3].column_row.copy()
    spoilt[[5, 20]] += [[4.0, -3.0], [-2.0, 6.0]]
    detections[3] = detections[3]._replace(column_row=spoilt)
    rng = np.random.default_rng(9)
    other = rng.uniform(50, 900, (40, 2))
    detections.append(Detection("other", np.arange(40), other, np.full((40, 2), SIGMA_PX)))
    detections.append(detections[0].take(np.arange(4))._replace(image="few"))
    detections.append(detections[1].take(detections[1].point // 9 == 3)._replace(image="row"))
    return calibrate(board, detections, SENSOR)


def test_recovers_the_camera_within_its_standard_deviations(simulated):
    assert simulated.adjusted.outcome is Outcome.CONVERGED
    tables = Tables(simulated.adjusted).interior.set_index("parameter")
    for name in free_parameters("smac", Smac()):
        value, sigma = tables.loc[name, ["value", "sigma"]]
        assert abs(value - float(get_parameter(WIDE, name))) < 3 * sigma, name
    # sigma naught is 1 where nothing but the noise of the measurement is left.
    assert float(simulated.adjusted.sigma0) == pytest.approx(1.0, abs=0.08)
    assert simulated.added_sigma_px < 0.5 * SIGMA_PX
    assert simulated.rms_px == pytest.approx(np.sqrt(2) * SIGMA_PX, rel=0.1)
    rays = _rays(simulated.interior), _rays(WIDE)
    assert np.abs(rays[0] - rays[1]).max() < 3e-3


def test_gross_errors_are_found_and_named(simulated):
    assert set(simulated.left_out) == {"other", "few", "row"}
    assert simulated.settled
    assert simulated.converged
    wrong = {point for image, point in simulated.removed if image == "i3"}
    third = seen(flat_board(), views(flat_board(), 12), SIGMA_PX)[3]
    assert {flat_board().points[third.point[k]] for k in (5, 20)} <= wrong
    assert len(simulated.removed) <= 4


_ideal = compiled(lambda interior, xy: jax.vmap(interior.ideal_from_measured)(xy))


def _rays(interior) -> np.ndarray:
    """Ideal coordinates over c, at points of the format."""
    side = [np.linspace(-0.45, 0.45, 11) * s for s in (SENSOR.width_mm, SENSOR.height_mm)]
    grid = np.stack(np.meshgrid(*side), axis=-1).reshape(-1, 2)
    return _ideal(jax.tree.map(np.float64, interior), grid) / float(interior.c)


def test_any_balance_radius_gives_the_same_bundle(simulated):
    board = flat_board()
    again = calibrate(board, seen(board, views(board, 12), 8 * SIGMA_PX), SENSOR)
    balanced = calibrate(board, seen(board, views(board, 12), 8 * SIGMA_PX), SENSOR, r0_mm=2.5)
    assert float(balanced.interior.distortion.r0) == 2.5
    assert np.abs(_rays(again.interior) - _rays(balanced.interior)).max() < 1e-9
    assert np.abs(_rays(rebalance(again.interior, 2.5)) - _rays(balanced.interior)).max() < 1e-9
    assert balanced.rms_px == pytest.approx(again.rms_px, rel=1e-9)


def test_too_few_targets_in_every_photograph_are_said():
    few = [
        d._replace(point=d.point[:5], column_row=d.column_row[:5], sigma_px=d.sigma_px[:5])
        for d in seen(flat_board(), views(flat_board(), 3), 0.0)
    ]
    with pytest.raises(InputError, match="0 of 3 photographs show enough of the board"):
        calibrate(flat_board(), few, SENSOR)


def test_start_needs_nothing_but_tilted_views():
    board = flat_board()
    pairs = [(board.xyz_m[d.point, :2], SENSOR.mm_from_px(d.column_row)) for d in seen(board, views(board, 6), 0.2)]
    start, told = flat_start(pairs, SENSOR, 8.0)
    assert told
    assert float(start.c) == pytest.approx(float(WIDE.c), rel=0.05)
    # From straight above nothing tells c from the height.
    above = ExteriorOrientation(np.array([0.12, -0.09, 0.2]), np.eye(3))  # type: ignore[arg-type]
    level = [(board.xyz_m[d.point, :2], SENSOR.mm_from_px(d.column_row)) for d in seen(board, [above] * 3, 0.0)]
    assert not flat_start(level, SENSOR, 8.0)[1]


def test_views_of_one_row_do_not_spoil_the_start():
    """Nor those of a row and one point beside it: of them many homographies are right."""
    board = flat_board()
    detections = seen(board, views(board, 6), 0.2)
    row = [d.take(d.point // 9 == 3) for d in detections]
    beside = [d.take((d.point // 9 == 3) | (d.point == 40)) for d in detections]
    pairs, rows, more = (
        [(board.xyz_m[d.point, :2], SENSOR.mm_from_px(d.column_row)) for d in some]
        for some in (detections, row, beside)
    )
    start, _ = flat_start(pairs, SENSOR, 8.0)
    again, message = flat_start(pairs + rows + more, SENSOR, 8.0)
    assert message
    assert float(again.c) == pytest.approx(float(start.c), rel=1e-9)
    assert not flat_start(rows + more, SENSOR, 8.0)[1]


def test_rounds_that_do_not_come_to_rest_are_said(monkeypatch):
    monkeypatch.setattr(target_calibration, "_ROUNDS", 1)
    done = calibrate(flat_board(), seen(flat_board(), views(flat_board(), 12), SIGMA_PX), SENSOR)
    assert bool(done.adjusted.converged)
    assert not done.settled
    assert not done.converged
    assert "did not converge" in findings(done)[0]


def test_field_on_a_wall_gives_the_same_camera(simulated):
    """Its coordinates turned so that Z runs along the wall, and measured off it by a tenth of a millimetre."""
    board = flat_board()
    detections = seen(board, views(board, 12), SIGMA_PX)
    turn = np.array([[0.6, 0, 0.8], [0.8, 0, -0.6], [0, 1, 0]])  # object from board
    assert np.linalg.det(turn) == pytest.approx(1)
    xyz = board.xyz_m + np.array([0, 0, 1e-4]) * np.random.default_rng(2).standard_normal(board.xyz_m.shape)
    on_wall = calibrate(board._replace(xyz_m=xyz @ turn.T + [10.0, 20.0, 1.5]), detections, SENSOR)
    assert on_wall.adjusted.outcome is Outcome.CONVERGED
    assert not on_wall.left_out
    assert np.abs(_rays(on_wall.interior) - _rays(WIDE)).max() < 0.02
    back = np.asarray(on_wall.adjusted.unknowns.exterior.camera_from_object) @ turn
    truth = np.stack([np.asarray(e.camera_from_object) for e in views(board, 12)])
    assert np.abs(back - truth).max() < 0.02


@pytest.mark.parametrize("name", ["smac", "balanced", "bundler_radial"])
def test_another_model_begins_where_the_rays_are_nearest(name):
    known = InteriorOrientation(3.1, distortion=Brown(k1=-0.02, k2=-0.001))
    model = distortion_model(name, SENSOR)
    begun = nearest_distortion(known, model, free_parameters(name, model), SENSOR)
    off = np.abs(_rays(begun) - _rays(known)).max()
    assert off < {"smac": 1e-9, "balanced": 0.02, "bundler_radial": 0.06}[name]


@pytest.mark.slow
def test_circles_of_two_sizes_are_no_blunders():
    """Their centres are off by several times the noise before they are corrected for, each size by another amount."""
    board = flat_board()
    board = board._replace(diameter_m=np.where(np.arange(len(board.points)) % 10, 0.016, 0.004))
    detections, noise = [], 0.004
    for exterior, d in zip(views(board, 8), seen(board, views(board, 8), noise), strict=True):
        n = len(d.point)
        place = np.tile(exterior.position, (n, 1)), np.tile(exterior.camera_from_object, (n, 1, 1))
        radius = board.diameter_m[d.point] / 2
        off = eccentricities(WIDE, *place, board.xyz_m[d.point], np.eye(3)[:, :2], radius) / SENSOR.pixel_mm
        assert np.abs(off).max() > 20 * noise
        detections.append(d._replace(column_row=d.column_row + off * (1, -1)))
    done = calibrate(board, detections, SENSOR)
    assert done.settled and not done.removed and not done.left_out
    assert done.added_sigma_px < noise
    tables = Tables(done.adjusted)
    off = [(s.value - float(get_parameter(WIDE, s.parameter))) / s.sigma for s in tables.significance]
    assert np.abs(off).max() < 3.5


def test_eccentricity_is_that_of_the_ellipse_in_closed_form():
    """Without distortion: the centre of the conic H^-T diag(1, 1, -1) H^-1 minus the image of the centre."""
    board = flat_board()
    lens, centre, radius = InteriorOrientation(3.1, 0.02, 0.01), np.array([0.1, -0.05, 0.0]), 0.012
    of_view = compiled(lambda exterior: eccentricity(lens, exterior, centre, np.eye(3)[:, :2], radius))
    for exterior in views(board, 4):
        matrix, position = np.asarray(exterior.camera_from_object), np.asarray(exterior.position)
        k = np.array([[-3.1, 0, 0.02], [0, -3.1, 0.01], [0, 0, 1]])
        h = k @ np.column_stack([radius * matrix[:, :2], matrix @ (centre - position)])
        conic = np.linalg.inv(h).T @ np.diag([1.0, 1.0, -1.0]) @ np.linalg.inv(h)
        ellipse = np.linalg.solve(conic[:2, :2], -conic[:2, 2])
        image = h[:, 2] / h[2, 2]
        found = of_view(exterior)
        np.testing.assert_allclose(found, ellipse - image[:2], atol=1e-12)
        assert np.linalg.norm(ellipse - image[:2]) > 1e-3 * SENSOR.pixel_mm


def test_added_sigma_makes_the_square_sum_the_redundancy():
    rng = np.random.default_rng(0)
    sigma = rng.uniform(0.01, 0.2, (4000, 2))
    residuals = np.hypot(sigma, 0.3) * rng.standard_normal(sigma.shape)
    assert added_sigma(residuals, sigma, sigma.size) == pytest.approx(0.3, rel=0.03)
    assert added_sigma(0.5 * sigma, sigma, sigma.size) == 0.0


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"model": "fisheye"}, ["fisheye", "brown"]),
        ({"model": "brown", "r0_mm": 2.0}, ["R0", "smac"]),
        ({"r0_mm": 50.0}, ["R0 = 50 mm"]),
        ({"free": ["c", "k9"]}, ["k9", "c_mm"]),
        ({"free": ["c", "k0"]}, ["k0", "scale"]),
        ({}, ["2 of 2 photographs", "3"]),
    ],
)
def test_bad_input_is_one_sentence(arguments, words):
    board = flat_board()
    with pytest.raises(InputError) as error:
        calibrate(board, seen(board, views(board, 2), 0.1), SENSOR, **arguments)
    for word in words:
        assert word in str(error.value)
