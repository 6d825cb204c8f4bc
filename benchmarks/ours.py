"""A problem as a block of jaxphoto, and jaxphoto in a process of its own.

python benchmarks/ours.py FILE    FILE.npz of `blocks`, or a BAL file; solves once for each line it is sent
"""

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import equinox as eqx
import numpy as np
from blocks import Problem, read_npz
from machine import memory, pinned

import jaxphoto
from jaxphoto import FREE, Unknowns, read_source
from jaxphoto.adjustment import solve
from jaxphoto.block import Block, Datum, Start
from jaxphoto.camera import Brown, InteriorOrientation, Sensor, set_parameter
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.observations import Attitudes, CameraPositions, ControlCoordinates, Distances, ImagePoints
from jaxphoto.unknowns import default_priors

NAMES = ("c_mm", "xp_mm", "yp_mm", "k1", "k2")
SIGN = np.array([1.0, 1.0, 1.0, -1.0, -1.0])


def read_block(file: Path) -> Block:
    """The block in a file of arrays or in a BAL file."""
    return block_of(read_npz(file), file.stem) if file.suffix == ".npz" else read_source(file, "bal")


def block_of(problem: Problem, title: str) -> Block:
    """The same as a `Block`, start values included."""
    p = problem
    n_images, n_points = len(p.init_eop), len(p.init_pts)
    c, x_p, y_p, k1, k2 = map(float, SIGN * p.init_iop)
    camera = InteriorOrientation(c, x_p, y_p, Brown(k1=k1, k2=k2), residuals="model")  # as the other solvers
    exterior = ExteriorOrientation.from_angles(p.init_eop[:, 3:], p.init_eop[:, :3])
    start = Unknowns({"cam": camera}, exterior, p.init_pts, {}, {})
    priors = default_priors(start)
    interior = priors.interior["cam"]
    for name in NAMES:
        interior = set_parameter(interior, name, FREE)
    return Block(
        title=title,
        images=tuple(f"i{k}" for k in range(n_images)),
        points=tuple(f"p{k}" for k in range(n_points)),
        sensors={"cam": Sensor(4500, 3000, 0.008)},
        image_camera=("cam",) * n_images,
        image_mount=("",) * n_images,
        image_strip=tuple(f"S{k}" for k in p.strip),
        image_time=np.zeros(n_images),
        image_points=ImagePoints(p.obs_img, p.obs_pt, p.obs_xy, np.full(p.obs_xy.shape, p.sigma_img)),
        control=_rows(p.gcp_pt, p.gcp_obs, p.gcp_sigma),
        fixed=ControlCoordinates.none(),
        check=ControlCoordinates.none(),
        stations=_rows(np.arange(n_images), p.sta_obs, p.sta_sigma, CameraPositions),
        attitudes=Attitudes.none(),
        distances=Distances.none(),
        datum=Datum(),
        start=Start(start, np.ones(n_images, bool), np.ones(n_points, bool)),
        priors=eqx.tree_at(lambda q: q.interior["cam"], priors, interior),
    )


def _rows(who: np.ndarray, values: np.ndarray, sigmas: np.ndarray, kind=ControlCoordinates):
    n = len(who)
    return kind(np.repeat(who, 3), np.tile(np.arange(3), n), np.ravel(values), np.ravel(sigmas))


class Worker:
    """A long-lived process that holds the block and solves it on request."""

    def __init__(self, file: Path, cached: bool, cores: int | None):
        environment = os.environ | ({} if cached else {"JAX_ENABLE_COMPILATION_CACHE": "false"})
        command = pinned([sys.executable, __file__, str(file)], cores)
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )

    def solve(self) -> dict:
        """One warm solve."""
        stdin, stdout = self.process.stdin, self.process.stdout
        assert stdin is not None
        assert stdout is not None
        stdin.write("solve\n")
        stdin.flush()
        line = stdout.readline()
        if not line:
            raise SystemExit("our worker process failed; its message is above")
        return json.loads(line)

    def stop(self) -> None:
        """End the process."""
        if self.process.stdin:
            self.process.stdin.close()
        self.process.wait(timeout=60)


def _work(file: Path) -> None:
    """The worker: compile and warm up once, then one solve a line."""
    block = read_block(file)

    def once() -> tuple:
        began = time.perf_counter()
        adjusted = solve(block, block.start.unknowns, block.priors)
        whole, peak = time.perf_counter() - began, memory("VmHWM")
        jaxphoto.covariance(adjusted)
        return adjusted, whole, peak

    # Of later solves the peak is that of the covariances before them.
    first, _, peak = once()
    once()
    for _ in sys.stdin:
        adjusted, whole, _ = once()
        record = {
            "solver": "jaxphoto",
            "solve_s": adjusted.seconds["solve"],
            "call_s": whole,
            "covariance_s": adjusted.seconds["covariance"],
            "compile_s": first.seconds["compile"],
            "steps": int(adjusted.steps),
            "cost": float(adjusted.sum_of_squares) / 2,
            "memory_mb": peak,
            "memory_with_covariance_mb": memory("VmHWM"),
        }
        print(json.dumps(record), flush=True)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    _work(Path(sys.argv[1]))
