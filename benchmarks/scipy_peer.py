"""scipy's sparse least squares as a peer: python benchmarks/scipy_peer.py FILE.npz prints one JSON object."""

import json
import sys
import time
from pathlib import Path

import numpy as np
from blocks import Problem, read_npz, rotations
from machine import memory


class SparseModel:
    """Residual and sparse Jacobian in plain numpy, without JAX: derivatives by complex steps, exact to rounding.

    A residual touches one image, one point and the camera, so 14 complex evaluations give every column.
    """

    def __init__(self, problem: Problem):
        from scipy.sparse import csr_matrix

        self.p, self.csr = problem, csr_matrix
        p, n, m = problem, len(problem.init_eop), len(problem.init_pts)
        self.start = np.concatenate([p.init_iop, p.init_eop.ravel(), p.init_pts.ravel()])
        rows, columns = [], []
        k = len(p.obs_img)
        for column in range(14):
            if column < 5:
                touched = np.full(k, column)
            elif column < 11:
                touched = 5 + 6 * p.obs_img + column - 5
            else:
                touched = 5 + 6 * n + 3 * p.obs_pt + column - 11
            rows.append(np.arange(2 * k))
            columns.append(np.repeat(touched, 2))
        stations = (5 + 6 * np.arange(n)[:, None] + np.arange(3, 6)).ravel()
        control = (5 + 6 * n + 3 * p.gcp_pt[:, None] + np.arange(3)).ravel()
        rows.append(2 * k + np.arange(len(stations) + len(control)))
        columns.append(np.concatenate([stations, control]))
        self.rows, self.columns = np.concatenate(rows), np.concatenate(columns)
        self.shape = (2 * k + len(stations) + len(control), 5 + 6 * n + 3 * m)
        self.constant = np.concatenate([1 / p.sta_sigma.ravel(), 1 / p.gcp_sigma.ravel()])

    def split(self, x):
        n = len(self.p.init_eop)
        return x[:5], x[5 : 5 + 6 * n].reshape(n, 6), x[5 + 6 * n :].reshape(-1, 3)

    def image_rows(self, iop, eop, points):
        """Image residuals; the arguments are the camera, and exterior orientation and point of every row."""
        c, x_p, y_p, k1, k2 = iop
        u = np.einsum("nij,nj->ni", rotations(eop[:, :3]), points - eop[:, 3:])
        b = self.p.obs_xy - np.stack([x_p, y_p])
        r2 = np.sum(b * b, axis=1)[:, None]
        return (b * (1 + k1 * r2 + k2 * r2 * r2) + c * u[:, :2] / u[:, 2:]) / self.p.sigma_img

    def residual(self, x):
        p, (iop, eop, points) = self.p, self.split(x)
        stations = (eop[:, 3:] - p.sta_obs) / p.sta_sigma
        control = (points[p.gcp_pt] - p.gcp_obs) / p.gcp_sigma
        image = self.image_rows(iop, eop[p.obs_img], points[p.obs_pt])
        return np.concatenate([image.ravel(), stations.ravel(), control.ravel()])

    def jacobian(self, x):
        p, (iop, eop, points) = self.p, self.split(x)
        values, own_eop, own_points = [], eop[p.obs_img], points[p.obs_pt]
        for column in range(14):
            parts = [iop + 0j, own_eop + 0j, own_points + 0j]
            part, k = (0, column) if column < 5 else (1, column - 5) if column < 11 else (2, column - 11)
            parts[part][..., k] += 1e-30j
            values.append(self.image_rows(*parts).imag.ravel() / 1e-30)
        values.append(self.constant)
        return self.csr((np.concatenate(values), (self.rows, self.columns)), self.shape)


def _solve(path: Path) -> None:
    import scipy
    from scipy.optimize import least_squares

    model = SparseModel(read_npz(path))
    settings = {"atol": 1e-8, "btol": 1e-8, "maxiter": 20_000, "regularize": True}
    began = time.perf_counter()
    solution = least_squares(
        model.residual,
        model.start,
        jac=model.jacobian,
        method="trf",
        tr_solver="lsmr",
        tr_options=settings,
        x_scale="jac",
        ftol=1e-10,
        xtol=1e-14,
        gtol=1e-14,
    )
    seconds = time.perf_counter() - began
    print(
        json.dumps(
            {
                "solver": f"scipy {scipy.__version__} trf + lsmr",
                "solve_s": seconds,
                "steps": int(solution.nfev),
                "cost": float(solution.cost),
                "memory_mb": memory("VmHWM"),
            }
        )
    )


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    _solve(Path(sys.argv[1]))
