"""Joint adjustment of trajectory, scanner and camera, compared with independent formulas."""

import dataclasses
import functools

import jax
import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from jaxphoto import BlockError, InputError, JaxphotoError, adjust, bias, covariance, read_block, write_block
from jaxphoto.adjustment import Outcome
from jaxphoto.camera import get_parameter
from jaxphoto.observations import Attitudes, CameraPositions, StripPlanes
from jaxphoto.procedures.lidar import adjust_strips
from jaxphoto.procedures.lidar.iterate_to_convergence import at_result
from jaxphoto.procedures.lidar.strip_model import check_photographs
from jaxphoto.report import plot_scanner_correlation, plot_trajectory_errors
from jaxphoto.report.strips import all_correlations, errors_along
from jaxphoto.statistics import correlation_matrix
from tests.commands import run
from tests.procedures.joint import CAMERA, fitted, flown, photographs, truth
from tests.procedures.strips import SETTINGS


def estimates() -> tuple[tuple[str, ...], np.ndarray, np.ndarray]:
    """Labels, values and covariance of all shared unknowns."""
    adjusted = fitted().adjusted
    labels = adjusted.structure.labels
    value = np.asarray(adjusted.values.shared)[adjusted.structure.free]
    return labels, value, np.asarray(fitted().covariance.matrix)[-len(labels) :, -len(labels) :]


def test_camera_and_scanner_are_recovered():
    """All of it together: chi squared of thirteen, because some of it is told apart badly."""
    labels, value, matrix = estimates()
    true = truth(flown())
    own = [labels.index(label) for label in true]
    off = value[own] - np.array(list(true.values()))
    assert len(own) == 13
    assert off @ np.linalg.solve(matrix[np.ix_(own, own)], off) < 34.5  # 99.9 %
    sigma = dict(zip(labels, np.sqrt(np.diagonal(matrix)), strict=True))
    # The photographs begin 0.25 mm off, which is sixty standard deviations.
    assert sigma["interior[kodak].c_mm"] < 0.006
    assert max(v for label, v in sigma.items() if label.startswith("mounts")) < 2e-4


def test_the_iteration_converges_with_correct_weights():
    found = fitted()
    assert found.converged and found.adjusted.outcome is Outcome.CONVERGED
    assert float(found.adjusted.sigma0) == pytest.approx(1.0, abs=0.1)
    over = [d for d in found.differences if d.one == "photographs"]
    assert [d.other for d in over] == ["1", "2", "3"]
    for d in over:
        # The principal distance that the photographs begin with is 0.7 % off.
        assert abs(d.mean_before_m) > 2.0 and abs(d.mean_m) < 0.003
        assert d.planes > 50 and d.rms_m < d.noise_m


def test_plots_show_names_literally():
    """A dollar begins a formula of matplotlib, and a unit may end a name."""
    result = fitted()
    named = dataclasses.replace(result, cloud=dataclasses.replace(result.cloud, strips=("L$^$1", "b_rad", "c")))
    plot_trajectory_errors(named, "L$^$1", Figure().add_subplot()).figure.draw_without_rendering()
    first, second = (plot_scanner_correlation(result, Figure().add_subplot(), itself=i) for i in (False, True))
    assert len(first.get_xticks()) == 8 and len(first.get_yticks()) == len(second.get_xticks()) == 5
    with pytest.raises(InputError, match="unknown strip 'x'; use one of 1, 2, 3"):
        plot_trajectory_errors(result, "x")


def test_errors_along_a_strip_have_the_spread_of_their_knots():
    """Of drawn knots, and about the truth."""
    result, strip = fitted(), 1
    labels, _, matrix = estimates()
    spline = result.errors.splines[strip]
    time = np.linspace(spline.times[0], spline.times[-1], 40)
    value, sigma = errors_along(result, strip, time)
    own = [k for k, label in enumerate(labels) if label.startswith("trajectory_knots")]
    rng = np.random.default_rng(3)
    knots = rng.multivariate_normal(np.zeros(len(own)), matrix[np.ix_(own, own)], 4000).reshape(4000, -1, 6)
    index, weights = spline.weights(time)
    drawn = np.einsum("tk,ntkc->ntc", weights, knots[:, index]).std(axis=0)
    units = [1.0] * 3 + [np.rad2deg(1.0)] * 3
    np.testing.assert_allclose(sigma, drawn * units, rtol=0.06)
    true = np.concatenate(flown().errors.at(strip, time), axis=1) * units
    assert (np.abs(value - true) < 4 * sigma).all()


def test_trajectory_errors_are_recovered():
    labels, value, matrix = estimates()
    errors = flown().errors
    own = [k for k, label in enumerate(labels) if label.startswith("trajectory_knots")]
    off = value[own] - np.column_stack([errors.position, errors.attitude]).ravel()
    assert np.mean(np.abs(off) < 3 * np.sqrt(np.diagonal(matrix)[own])) > 0.97


def test_the_table_of_correlations_is_complete():
    labels, _, _ = estimates()
    table = all_correlations(fitted())
    assert list(table.columns) == list(table.index) == list(labels)
    n = len(labels)
    np.testing.assert_array_equal(table.to_numpy(), correlation_matrix(fitted().covariance)[-n:, -n:])
    # Both boresights have the headings of the trajectory in common.
    assert table.loc["scanner.boresight_up_rad", "mounts[default].boresight_z_rad"] > 0.5


def vector_of(adjusted) -> np.ndarray:
    """All that is estimated: increments of exterior orientations, shared unknowns, points."""
    shared = np.asarray(adjusted.values.shared)[adjusted.structure.free]
    return np.concatenate([np.zeros(6 * len(adjusted.block.images)), shared, np.ravel(adjusted.unknowns.points)])


def turned(roll_pitch_yaw: np.ndarray) -> np.ndarray:
    """From right, forward, up to east, north, up: yaw from north clockwise, nose up, right wing down."""
    roll, pitch, yaw = np.moveaxis(np.asarray(roll_pitch_yaw), -1, 0)
    about = zip("zxy", (-yaw, pitch, roll), strict=True)
    heading, nose, wing = (Rotation.from_euler(axis, angle[:, None]) for axis, angle in about)
    return (heading * nose * wing).as_matrix()


def small(angles: np.ndarray) -> np.ndarray:
    """`rotation.small_rotation` of many: I - [angles]x to first order."""
    return Rotation.from_rotvec(-np.asarray(angles)).as_matrix()


def rotated(matrix: np.ndarray, vector: np.ndarray) -> np.ndarray:
    return np.einsum("nij,nj->ni", matrix, vector)


class Twin:
    """All residuals over their standard deviations by formulas written down here, as a function of one vector."""

    def __init__(self, adjusted) -> None:
        self.adjusted, self.block = adjusted, adjusted.block
        self.labels = list(adjusted.structure.labels)
        self.rows = {of.group: [] for of in self.block.more}
        for of in self.block.more:
            self.rows[of.group].append(jax.tree.map(np.asarray, of))
        self.n = len(self.block.images)

    def __call__(self, x: np.ndarray) -> np.ndarray:
        n, s = self.n, len(self.labels)
        eop, shared, points = x[: 6 * n].reshape(n, 6), x[6 * n : 6 * n + s], x[6 * n + s :].reshape(-1, 3)
        known = dict(zip(self.labels, shared, strict=True))
        exterior = self.adjusted.unknowns.exterior
        centre = np.asarray(exterior.position) + eop[:, :3]
        camera = small(eop[:, 3:]) @ np.asarray(exterior.camera_from_object)
        knots = np.array([known[label] for label in self.labels if label.startswith("trajectory_knots")]).reshape(-1, 6)
        calibration = [known[f"scanner_calibration.{name}"] for name in ("range_offset_m", "angle_scale_ppm")]
        boresight = np.array([known[f"scanner.boresight_{axis}_rad"] for axis in ("right", "forward", "up")])

        def returned(point, scanner, angles, which, weights):
            off, body = np.einsum("nk,nkc->nc", weights, knots[which]), turned(angles)
            right, forward, up = rotated(body.transpose(0, 2, 1), point - scanner).T
            length = np.sqrt(right**2 + forward**2 + up**2)
            turn = 1e-6 * calibration[1] * np.arctan2(right, -up)
            shot = [np.cos(turn) * right + np.sin(turn) * up, forward, np.cos(turn) * up - np.sin(turn) * right]
            shot = np.column_stack(shot) * (1 - calibration[0] / length)[:, None]
            shot = rotated(small(off[:, 3:]), rotated(np.tile(small(boresight), (len(shot), 1, 1)), shot))
            return scanner - off[:, :3] + rotated(body, shot)

        return np.concatenate(
            [
                self.image_points(known, centre, camera, points),
                *self.exposures(known, centre, camera, knots),
                *self.planes(returned, points),
                *self.steps(knots, calibration[0]),
            ]
        )

    def image_points(self, known, centre, camera, points) -> np.ndarray:
        rows = self.block.image_points
        c, x_p, y_p, k1, k2 = (known[f"interior[kodak].{name}"] for name in CAMERA)
        u, v, w = rotated(camera[rows.image], points[rows.point] - centre[rows.image]).T
        measured = np.asarray(rows.xy) - [x_p, y_p]
        r2 = np.sum(measured**2, axis=1)
        shrunk = 1 - k1 * r2 - k2 * r2**2
        off = measured * shrunk[:, None] + c * np.column_stack([u, v]) / w[:, None]
        # Back into the measured image, by the derivative of the ideal coordinate.
        outer = measured[:, :, None] * measured[:, None] * (2 * k1 + 4 * k2 * r2)[:, None, None]
        slope = shrunk[:, None, None] * np.eye(2) - outer
        return np.ravel(np.linalg.solve(slope, off[:, :, None])[:, :, 0] / np.asarray(rows.sigma))

    def exposures(self, known, centre, camera, knots):
        (s,), (a,) = self.rows["trajectory_stations"], self.rows["trajectory_attitudes"]
        boresight = np.array([known[f"mounts[default].boresight_{axis}_rad"] for axis in "xyz"])
        # The camera's x axis points forward, its y axis to the left.
        nominal = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
        body = camera.transpose(0, 2, 1) @ (nominal @ small(boresight)).T
        arm = np.asarray(self.block.start.unknowns.mounts["default"].lever_arm)
        off = np.einsum("nk,nkc->nc", s.weights, knots[s.knots])[:, :3]
        at = (centre + body @ arm)[s.who] + off
        yield (s.value - at[np.arange(len(at)), s.axis]) / s.sigma
        off = np.einsum("nk,nkc->nc", a.weights, knots[a.knots])[:, 3:]
        apart = body[a.image].transpose(0, 2, 1) @ turned(a.roll_pitch_yaw) @ small(off)
        right, forward, up = Rotation.from_matrix(apart).as_rotvec().T
        yield np.ravel(np.column_stack([forward, right, -up]) / a.sigma)

    def planes(self, returned, points):
        (of,) = self.rows["strip_planes"]
        names = ("point", "scanner", "roll_pitch_yaw", "knots", "weights")
        one, other = (returned(*(getattr(of, f"{name}_{side}") for name in names)) for side in "ab")
        yield np.einsum("ni,ni->n", of.normal, one - other) / of.sigma
        for of in self.rows["strip_points"]:
            foot = returned(of.foot, of.scanner, of.roll_pitch_yaw, of.knots, of.weights)
            yield np.einsum("ni,ni->n", of.normal, points[of.point] - foot) / of.sigma

    def steps(self, knots, range_offset):
        for group, own in (("position_steps", slice(0, 3)), ("attitude_steps", slice(3, 6))):
            (of,) = self.rows[group]
            yield np.ravel((knots[of.end, own] - of.kept[:, None] * knots[of.start, own]) / of.sigma)
        first = knots[[spline.first for spline in fitted().errors.splines]]
        yield np.ravel(first / np.append(np.full(3, SETTINGS.sigma_position_m), SETTINGS.sigma_attitude))
        yield np.array([range_offset / 0.1])


def test_the_result_is_that_of_dense_least_squares_by_other_formulas():
    adjusted = fitted().adjusted
    twin, x = Twin(adjusted), vector_of(adjusted)
    r = twin(x)
    assert r @ r == pytest.approx(float(adjusted.sum_of_squares), rel=1e-9)
    n = 6 * twin.n + len(twin.labels)
    # Steps of a hundredth of a standard deviation or so: differences are right to five digits.
    step = np.full(len(x), 1e-4)
    step[:n] = 0.01 * np.sqrt(np.diagonal(np.asarray(fitted().covariance.matrix)))
    steps = np.diag(step)
    scaled = np.column_stack([(twin(x + h) - twin(x - h)) / 2 for h in steps])
    normal = scaled.T @ scaled
    cofactors = np.linalg.inv(normal) * step[:, None] * step
    sigma = np.sqrt(np.diagonal(cofactors))
    move = -np.linalg.solve(normal, scaled.T @ r) * step
    assert np.max(np.abs(move) / sigma) < 1e-3
    expected = np.asarray(fitted().covariance.matrix)
    # Rotations are reported about other axes than those of the increments.
    same = [k for k in range(n) if k >= 6 * twin.n or k % 6 < 3]
    unit = sigma[same, None] * sigma[same]
    at = np.ix_(same, same)
    np.testing.assert_allclose(cofactors[at] / unit, expected[at] / unit, atol=1e-4)


def test_the_camera_of_the_photographs_alone_is_told_from_the_start():
    """Before all of it the photographs were adjusted with their interior orientation held."""
    before = fitted().before
    assert before is not None
    held = float(get_parameter(before.unknowns.interior["kodak"], "c_mm"))
    assert held == float(get_parameter(flown().block.start.unknowns.interior["kodak"], "c_mm"))


def test_what_cannot_be_adjusted_together():
    flight, taken = flown(), photographs(flown())

    def refused(error, match, changed=taken, trajectory=flight.trajectory):
        with pytest.raises(error, match=match):
            adjust_strips(flight.cloud, trajectory, SETTINGS, photographs=changed)

    refused(InputError, "need their common trajectory", trajectory=None)
    untimed = np.where(np.arange(len(taken.time)) == 3, np.nan, taken.time)
    refused(InputError, "image A_04 has no time_s", taken._replace(time=untimed))
    gone = "image A_01 was exposed at .* where the trajectory has no records"
    refused(BlockError, gone, taken._replace(time=taken.time - 60.0))
    other = gone + r".*seconds of a GPS week.*or the exposures -172800 s later, all within the trajectory"
    refused(BlockError, other, taken._replace(time=taken.time + 172_800.0))
    kept = np.abs(np.asarray(flight.trajectory.time) - taken.time[0]) > 0.2
    cut = dataclasses.replace(flight.trajectory, **{f: v[kept] for f, v in vars(flight.trajectory).items()})
    with pytest.raises(BlockError, match=r"image A_01 was exposed at .* where the trajectory has no records"):
        check_photographs(taken, cut)
    bare = dataclasses.replace(taken.block, stations=CameraPositions.none(), attitudes=Attitudes.none())
    refused(InputError, "the block has no stations", taken._replace(block=bare))
    late = taken.time + np.where(taken.time > 0, -1.0, 1.0)
    refused(BlockError, "stations of the block are .* m from the trajectory", taken._replace(time=late))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("joint") / "block"
    result = fitted().adjusted
    write_block(at_result(result.block, result.unknowns), path)
    return path


@functools.cache
def read(folder):
    return read_block(folder)


def test_the_block_comes_back_and_adjusts_to_the_same(folder):
    before = fitted().adjusted
    after = adjust(read(folder))
    labels = before.structure.labels
    assert after.structure.labels == labels
    assert after.redundancy == before.redundancy
    sigma = np.asarray(fitted().covariance.shared_sigma)
    one, other = (np.asarray(a.values.shared)[a.structure.free] for a in (before, after))
    # Both ended within a hundred-thousandth of a standard deviation of the optimum, and far nearer in fact.
    np.testing.assert_allclose((other - one) / sigma, 0.0, atol=1e-6)
    np.testing.assert_allclose(covariance(after).shared_sigma, sigma, rtol=1e-9)
    for name, rows in before.block.named_observations.items():
        assert len(after.block.named_observations[name]) == len(rows)
    assert list(read(folder).start.unknowns.more["trajectory_knots"]) == list(before.unknowns.more["trajectory_knots"])
    assert bias(read(folder), "trajectory", 0.1, "strip").names[:3] == ("1.X_m", "1.Y_m", "1.Z_m")


@pytest.mark.parametrize(
    ("file", "old", "new", "match"),
    [
        ("trajectory_stations.csv", ",0,", ",3,", r"row 2: axis is 3; it is 0, 1 or 2"),
        ("position_steps.csv", "1 at ", "7 at ", r"row 2: trajectory_knots 7 at .* is none of the trajectory_knots"),
    ],
)
def test_mistakes_are_named(folder, tmp_path, file, old, new, match):
    copy = tmp_path / "copy"
    copy.mkdir()
    for path in folder.glob("[!.]*"):
        text = path.read_text()
        if path.name == file:
            assert old in text
            text = text.replace(old, new, 1)
        (copy / path.name).write_text(text)
    with pytest.raises(JaxphotoError, match=match):
        read_block(copy)


@pytest.mark.slow
def test_commands_take_the_block(folder, tmp_path, monkeypatch, capsys):
    given = ("--bias", "trajectory", "--per", "strip", "--sigma-m", "0.05", "--draws", "20")
    code, said, _ = run(monkeypatch, capsys, "monte-carlo", folder, *given, "--out", tmp_path / "draws")
    assert code == 0 and "20 draws, 20 converged" in said
    assert run(monkeypatch, capsys, "sensitivity", folder, "--out", tmp_path / "sensitivity")[0] == 0


# On ridges of the roofs of `two_strips`, which lie along Y.


def test_the_block_of_a_joint_adjustment_is_not_joined_again():
    flight = flown()
    joined = dataclasses.replace(flight.block, more=(*flight.block.more, StripPlanes.none()))
    with pytest.raises(BlockError, match=r"result of a joint adjustment \(planes in strip_planes"):
        check_photographs(photographs(flight)._replace(block=joined), flight.trajectory)
