"""pyceres as a peer, with cost functions in Python: python benchmarks/pyceres_peer.py FILE.npz prints one JSON object.

Its Ceres calls back into Python for each image point, so most of the time is Python's: what a user of pyceres gets who
has a model of his own.
"""

import json
import math
import sys
import time
from pathlib import Path

import numpy as np
import pyceres
from blocks import Problem, read_npz
from machine import memory


class ImagePoint(pyceres.CostFunction):
    """Two residuals of one image point, in plain floats: numpy would be slower on so few numbers."""

    def __init__(self, xy, sigma: float):
        super().__init__()
        self.xy, self.weight = xy, 1 / sigma
        self.set_num_residuals(2)
        self.set_parameter_block_sizes([5, 6, 3])

    def Evaluate(self, parameters, residuals, jacobians):
        """Residuals and, where they are asked for, their derivatives, row by row."""
        c, x_p, y_p, k1, k2 = parameters[0].tolist()
        omega, phi, kappa, *centre = parameters[1].tolist()
        so, co, sp, cp = math.sin(omega), math.cos(omega), math.sin(phi), math.cos(phi)
        sk, ck = math.sin(kappa), math.cos(kappa)
        r1 = (cp * ck, co * sk + so * sp * ck, so * sk - co * sp * ck)
        r2 = (-cp * sk, co * ck - so * sp * sk, so * ck + co * sp * sk)
        r3 = (sp, -so * cp, co * cp)
        d = [a - b for a, b in zip(parameters[2].tolist(), centre, strict=True)]
        u, v, w = (r[0] * d[0] + r[1] * d[1] + r[2] * d[2] for r in (r1, r2, r3))
        x, y, weight = self.xy[0] - x_p, self.xy[1] - y_p, self.weight
        square = x * x + y * y
        factor = 1 + square * (k1 + square * k2)
        residuals[0] = weight * (x * factor + c * u / w)
        residuals[1] = weight * (y * factor + c * v / w)
        if jacobians is None:
            return True
        scale = weight * c / w
        p, q = u / w, v / w

        def along(a, b, e):
            """What both residuals change by when (u, v, w) moves by (a, b, e)."""
            return scale * (a - p * e), scale * (b - q * e)

        if jacobians[0] is not None:
            slope = 2 * (k1 + 2 * square * k2)
            xy = -weight * slope * x * y
            x_row = (weight * p, -weight * (factor + slope * x * x), xy, weight * x * square, weight * x * square**2)
            y_row = (weight * q, xy, -weight * (factor + slope * y * y), weight * y * square, weight * y * square**2)
            jacobians[0][:] = x_row + y_row
        by_point = [along(*column) for column in zip(r1, r2, r3, strict=True)]
        if jacobians[1] is not None:
            # Each angle turns (u, v, w) about its axis as the camera sees it: -axis x (u, v, w).
            axes = ((r1[0], r2[0], r3[0]), (sk, ck, 0.0), (0.0, 0.0, 1.0))
            turns = [along(v * e - w * b, w * a - u * e, u * b - v * a) for a, b, e in axes]
            columns = turns + [(-a, -b) for a, b in by_point]
            jacobians[1][:] = [a for a, _ in columns] + [b for _, b in columns]
        if jacobians[2] is not None:
            jacobians[2][:] = [a for a, _ in by_point] + [b for _, b in by_point]
        return True


class Observed(pyceres.CostFunction):
    """Three observed coordinates: the last three of a parameter block."""

    def __init__(self, size: int, values: np.ndarray, sigmas: np.ndarray):
        super().__init__()
        self.values, self.sigmas = values, sigmas
        self.jacobian = np.hstack([np.zeros((3, size - 3)), np.diag(1 / sigmas)]).ravel()
        self.set_num_residuals(3)
        self.set_parameter_block_sizes([size])

    def Evaluate(self, parameters, residuals, jacobians):
        """Residuals and derivatives."""
        residuals[:] = (parameters[0][-3:] - self.values) / self.sigmas
        if jacobians is not None:
            jacobians[0][:] = self.jacobian
        return True


def _problem(p: Problem, loss: pyceres.LossFunction | None = None) -> tuple[pyceres.Problem, list]:
    """The problem, and what it refers to and must therefore be kept, the camera first; `loss` is of every cost."""
    camera, images, points = p.init_iop.copy(), list(p.init_eop.copy()), list(p.init_pts.copy())
    problem, kept = pyceres.Problem(), [camera, images, points]

    def add(cost, blocks):
        problem.add_residual_block(cost, loss, blocks)
        kept.append(cost)

    for i, j, xy in zip(p.obs_img, p.obs_pt, p.obs_xy.tolist(), strict=True):
        add(ImagePoint(xy, p.sigma_img), [camera, images[i], points[j]])
    for image, values, sigmas in zip(images, p.sta_obs, p.sta_sigma, strict=True):
        add(Observed(6, values, sigmas), [image])
    for j, values, sigmas in zip(p.gcp_pt, p.gcp_obs, p.gcp_sigma, strict=True):
        add(Observed(3, values, sigmas), [points[j]])
    return problem, kept


def robust_camera(p: Problem, scale: float) -> np.ndarray:
    """c, x_p, y_p, k1, k2 where a Cauchy loss of `scale` standard deviations is put on every cost."""
    problem, kept = _problem(p, loss=pyceres.CauchyLoss(scale))
    pyceres.solve(_options(), problem, pyceres.SolverSummary())
    return kept[0]


def _options() -> pyceres.SolverOptions:
    options = pyceres.SolverOptions()
    options.linear_solver_type = pyceres.LinearSolverType.DENSE_SCHUR
    options.function_tolerance, options.initial_trust_region_radius = 1e-8, 1e8
    options.gradient_tolerance = options.parameter_tolerance = 1e-14
    options.num_threads = 1
    return options


def _solve(file: Path) -> None:
    problem, _kept = _problem(read_npz(file))
    options, summary = _options(), pyceres.SolverSummary()
    began = time.perf_counter()
    pyceres.solve(options, problem, summary)
    record = {
        "solver": f"pyceres {pyceres.__version__}, costs in Python",
        "solve_s": time.perf_counter() - began,
        "steps": summary.num_successful_steps - 1,
        "cost": summary.final_cost,
        "memory_mb": memory("VmHWM"),
    }
    print(json.dumps(record))


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    _solve(Path(sys.argv[1]))
