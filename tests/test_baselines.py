"""P31, the block that other solvers (Ceres, scipy, GTSAM) brought to the same optimum: ours against theirs."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import equinox as eqx
import numpy as np
import pytest

from jaxphoto import FREE, Unknowns, adjust, covariance, read_block, write_block
from jaxphoto.adjustment import Outcome
from jaxphoto.block import Block, Datum, Start
from jaxphoto.camera import Brown, InteriorOrientation, Sensor, set_parameter
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.observations import Attitudes, CameraPositions, ControlCoordinates, Distances, ImagePoints
from jaxphoto.statistics import redundancy_numbers
from jaxphoto.unknowns import default_priors

NAMES = ("c_mm", "xp_mm", "yp_mm", "k1", "k2")
# The baselines add k1 and k2, Brown subtracts them; their residuals are those of corrected coordinates.
SIGN = np.array([1.0, 1.0, 1.0, -1.0, -1.0])


@pytest.fixture(scope="module")
def baselines(data_dir):
    folder = Path(os.environ.get("JAXPHOTO_BASELINES", data_dir.parent / "baselines"))
    if not (folder / "gen" / "generate.py").is_file():
        pytest.skip(f"no baselines in {folder}: set JAXPHOTO_BASELINES to the folder that holds gen and reference")
    return folder


def xyz_rows(who, values, sigmas, kind=ControlCoordinates):
    n = len(who)
    return kind(np.repeat(who, 3), np.tile(np.arange(3), n), np.ravel(values), np.ravel(sigmas))


def block_of(npz: Path) -> Block:
    d = np.load(npz)
    n_images, n_points = len(d["init_eop"]), len(d["init_pts"])
    order = np.lexsort((d["obs_img"], d["obs_pt"]))
    c, x_p, y_p, k1, k2 = SIGN * d["init_iop"]
    start = Unknowns(
        {"cam": InteriorOrientation(c, x_p, y_p, Brown(k1=k1, k2=k2), residuals="model")},
        ExteriorOrientation.from_angles(d["init_eop"][:, 3:], d["init_eop"][:, :3]),
        d["init_pts"],
        {},
        {},
    )
    priors = default_priors(start)
    camera = priors.interior["cam"]
    for name in NAMES:
        camera = set_parameter(camera, name, FREE)
    return Block(
        title=npz.stem,
        images=tuple(f"i{k}" for k in range(n_images)),
        points=tuple(f"p{k}" for k in range(n_points)),
        sensors={"cam": Sensor(4500, 3000, 0.008)},
        image_camera=("cam",) * n_images,
        image_mount=("",) * n_images,
        image_strip=("",) * n_images,
        image_time=np.zeros(n_images),
        image_points=ImagePoints(
            d["obs_img"][order], d["obs_pt"][order], d["obs_xy"][order], np.full(d["obs_xy"].shape, d["sigma_img"])
        ),
        control=xyz_rows(d["gcp_pt"], d["gcp_obs"], d["gcp_sigma"]),
        fixed=ControlCoordinates.none(),
        check=ControlCoordinates.none(),
        stations=xyz_rows(np.arange(n_images), d["sta_obs"], d["sta_sigma"], CameraPositions),
        attitudes=Attitudes.none(),
        distances=Distances.none(),
        datum=Datum(),
        start=Start(start, np.ones(n_images, bool), np.ones(n_points, bool)),
        priors=eqx.tree_at(lambda u: u.interior["cam"], priors, camera),
    )


def vector_of(unknowns: Unknowns) -> np.ndarray:
    """The baselines' vector: interior, then angles and position of every image, then points."""
    camera = unknowns.interior["cam"]
    interior = SIGN * [float(v) for v in (camera.c, camera.xp, camera.yp, camera.distortion.k1, camera.distortion.k2)]
    exterior = np.hstack([np.asarray(unknowns.exterior.omega_phi_kappa), np.asarray(unknowns.exterior.position)])
    return np.concatenate([interior, exterior.ravel(), np.asarray(unknowns.points).ravel()])


class Solved:
    """Our adjustment beside the baselines' own residuals and analytic Jacobian at our optimum."""

    def __init__(self, block, problem, reference):
        self.block, self.problem, self.reference = block, problem, reference
        self.adjusted = adjust(block, block.start.unknowns)
        self.covariance = covariance(self.adjusted)
        self.x = vector_of(self.adjusted.unknowns)
        self.r = problem.residual(self.x)
        j = problem.jacobian(self.x).toarray()
        scale = 1 / np.sqrt((j**2).sum(0))
        self.j = j * scale
        self.q = np.linalg.inv(self.j.T @ self.j)
        self.step = -(self.q @ (self.j.T @ self.r)) * scale
        self.sigma = np.sqrt(np.diag(self.q)) * scale


@pytest.fixture(scope="module", params=["P31", pytest.param("P31c13", marks=pytest.mark.slow)])
def solved(request, baselines, tmp_path_factory):
    name, folder = request.param, tmp_path_factory.mktemp("baselines")
    subprocess.run([sys.executable, str(baselines / "gen" / "generate.py"), name, str(folder)], check=True)
    spec = importlib.util.spec_from_file_location("baseline_problem", baselines / "python" / "problem.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    npz = folder / f"{name}.npz"
    reference = json.loads((baselines / "reference" / f"{name}.json").read_text())
    return Solved(block_of(npz), module.Problem(str(npz)), reference)


def test_cost_redundancy_and_sigma0(solved):
    adjusted, reference = solved.adjusted, solved.reference
    assert adjusted.outcome is Outcome.CONVERGED
    assert abs(float(adjusted.sum_of_squares) / 2 / reference["cost"] - 1) < 1e-9
    assert abs(solved.r @ solved.r / float(adjusted.sum_of_squares) - 1) < 1e-12
    assert sum(adjusted.n_observations.values()) == reference["observations"]
    assert sum(adjusted.n_unknowns.values()) == reference["unknowns"]
    assert adjusted.redundancy == reference["redundancy"]
    assert abs(float(adjusted.sigma0) / reference["sigma0"] - 1) < 1e-9


def test_unknowns(solved):
    """Against the reference to the digits it holds, and every unknown by the baselines' own Gauss-Newton step."""
    n = 6 * len(solved.block.images) + 5
    for key, ours in (("iop", solved.x[:5]), ("eop0", solved.x[5:11]), ("point0", solved.x[n : n + 3])):
        sigma = {"iop": solved.sigma[:5], "eop0": solved.sigma[5:11], "point0": solved.sigma[n : n + 3]}[key]
        np.testing.assert_array_less(np.abs(ours - solved.reference[key]) / sigma, 1e-5)
    # The step is quadratically small beside the distance to the optimum, so this bounds all 752 unknowns.
    np.testing.assert_array_less(np.abs(solved.step) / solved.sigma, 1e-5)


def test_sigmas(solved):
    """Of all unknowns against the dense inverse of the baselines' normal matrix, and those in the reference."""
    n = 6 * len(solved.block.images)
    ours = np.sqrt(np.diag(np.asarray(solved.covariance.matrix)))
    exterior = ours[:n].reshape(-1, 6)[:, [3, 4, 5, 0, 1, 2]]
    points = np.sqrt(np.diagonal(np.asarray(solved.covariance.points), axis1=1, axis2=2))
    everything = np.concatenate([ours[n:], exterior.ravel(), points.ravel()])
    np.testing.assert_allclose(everything, solved.sigma, rtol=1e-6)
    for key, mine in (("sigma_iop", ours[n:]), ("sigma_eop0", exterior[0]), ("sigma_point_last", points[-1])):
        np.testing.assert_allclose(mine, solved.reference[key], rtol=1e-6)


def test_redundancy_numbers(solved):
    ours = redundancy_numbers(solved.adjusted, solved.covariance)
    dense = 1 - ((solved.j @ solved.q) * solved.j).sum(axis=1)
    n = 2 * len(solved.problem.ii)
    order = np.lexsort((solved.problem.ii, solved.problem.jj))
    np.testing.assert_allclose(np.asarray(ours.image).T, dense[:n].reshape(-1, 2)[order], atol=1e-9)
    np.testing.assert_allclose(np.concatenate([ours["control_points"], ours["stations"]]), dense[n:], atol=1e-9)


def test_by_way_of_a_block_folder(solved, tmp_path):
    write_block(solved.block, tmp_path / "block")
    block = read_block(tmp_path / "block")
    again = adjust(block)
    assert again.outcome is Outcome.CONVERGED
    assert abs(float(again.sum_of_squares) / 2 / solved.reference["cost"] - 1) < 1e-9
    order = [block.points.index(name) for name in solved.block.points]
    points = np.asarray(again.unknowns.points)[order]
    unknowns = eqx.tree_at(lambda u: u.points, again.unknowns, points)
    np.testing.assert_array_less(np.abs(vector_of(unknowns) - solved.x) / solved.sigma, 1e-5)
