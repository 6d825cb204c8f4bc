"""The solvers we are measured against; each solves in a process of its own and prints one JSON object.

python benchmarks/peers.py scipy FILE.npz        least_squares (trf, lsmr) with an exact sparse Jacobian
"""

import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

_CERES = {
    "P31": ["--solver", "dense_schur"],
    "B200": ["--solver", "sparse_schur", "--gcp-in-f", "1"],
}


def run_ceres(binary: Path, problem: Path, small: bool, *, covariance: bool = False) -> dict:
    """One solve of the C++ peer from the start values, to 1e-8 of the optimum; `small` blocks densely."""
    settings = _CERES["P31" if small else "B200"]
    command = [str(binary), str(problem), *settings, "--radius", "1e8", "--ftol", "1e-8"]
    record = _run([*command, *(["--cov", "schur"] if covariance else [])])
    return {
        "solver": f"Ceres {record['ceres']} {record['solver']}",
        "solve_s": record["t_solve"],
        "steps": record["iters"],
        "cost": record["cost"],
        "memory_mb": record["rss_mb"],
        "covariance_s": record.get("t"),
    }


def run_scipy(problem: Path) -> dict:
    """One solve by scipy, in a process of its own."""
    return _run([sys.executable, __file__, "scipy", str(problem)])


def peak_memory() -> float:
    """Peak resident memory of this process in MB, without what it inherited from the one that started it."""
    try:
        lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
        return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def _run(command: list[str]) -> dict:
    environment = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    # By way of a small shell: a process starts with the peak memory of the one it was forked from.
    small = ["sh", "-c", '"$0" "$@"; exit $?', *command]
    done = subprocess.run(small, capture_output=True, text=True, env=environment)
    if done.returncode:
        raise SystemExit(f"{Path(command[0]).name} failed: {done.stderr.strip()[-500:]}")
    record: dict = {}
    for line in done.stdout.splitlines():
        if line.startswith("{"):
            record |= json.loads(line)
    return record


class SparseModel:
    """Residual and sparse Jacobian in plain numpy, without JAX: derivatives by complex steps, exact to rounding.

    A residual touches one image, one point and the camera, so 14 complex evaluations give every column.
    """

    def __init__(self, problem):
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
        from blocks import rotations

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


def _solve_with_scipy(path: Path) -> None:
    import scipy
    from blocks import read_npz
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
                "memory_mb": peak_memory(),
            }
        )
    )


if __name__ == "__main__":
    if len(sys.argv) != 3 or sys.argv[1] != "scipy":
        raise SystemExit(__doc__)
    _solve_with_scipy(Path(sys.argv[2]))
