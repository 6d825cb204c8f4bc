"""mrcal as a peer: PYTHON benchmarks/mrcal_peer.py FILE.npz reads a board's corners and solves once a line it is sent,
then maps its projection uncertainty over 60 x 40 cells.

For the interpreter that has mrcal, which is the system's (Debian: python3-mrcal), so it imports nothing else of ours.
FILE holds `corners` (images, rows, columns, 3: x, y, weight; -1 where there is none), `intrinsics`, `rotation` and
`translation` (to the camera) to start with, `spacing_m`, `width_px` and `height_px`.
"""

import json
import sys
import time
from pathlib import Path

import mrcal
import numpy as np


def _inputs(problem) -> dict:
    """All that `mrcal.optimize` changes in place is a copy."""
    frames = [np.append(mrcal.r_from_R(r), t) for r, t in zip(problem["rotation"], problem["translation"], strict=True)]
    n = len(frames)
    return {
        "intrinsics": problem["intrinsics"][None].copy(),
        "extrinsics_rt_fromref": None,
        "frames_rt_toref": np.array(frames),
        "points": None,
        "observations_board": problem["corners"].copy(),
        "indices_frame_camintrinsics_camextrinsics": np.stack([np.arange(n), 0 * np.arange(n), -np.ones(n)], 1).astype(
            np.int32
        ),
        "observations_point": None,
        "indices_point_camintrinsics_camextrinsics": None,
        "lensmodel": "LENSMODEL_OPENCV8",
        "imagersizes": np.array([[problem["width_px"], problem["height_px"]]], np.int32),
        "calibration_object_spacing": float(problem["spacing_m"]),
        "calobject_warp": None,
        "do_optimize_calobject_warp": False,
        # These are so without saying, but `projection_uncertainty` looks for them.
        "do_optimize_intrinsics_core": True,
        "do_optimize_intrinsics_distortions": True,
        "do_optimize_extrinsics": True,
        "do_optimize_frames": True,
        "do_apply_outlier_rejection": False,
        "do_apply_regularization": False,
    }


def _memory_mb() -> float:
    lines = Path("/proc/self/status").read_text(encoding="utf-8").splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024


def _work(file: str) -> None:
    problem = dict(np.load(file))
    for _ in sys.stdin:
        inputs = _inputs(problem)
        wall, cpu = time.perf_counter(), time.process_time()
        found = mrcal.optimize(**inputs)
        record = {
            "solver": "mrcal",
            "solve_s": time.perf_counter() - wall,
            "cpu_s": time.process_time() - cpu,
            "square_sum": float(np.sum(found["x"] ** 2)),
        }
        model = mrcal.cameramodel(optimization_inputs=inputs, icam_intrinsics=0)
        x, y = (np.linspace(0, problem[key] - 1, n) for key, n in (("width_px", 60), ("height_px", 40)))
        cells = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        wall, cpu = time.perf_counter(), time.process_time()
        rays = mrcal.unproject(cells, *model.intrinsics(), normalize=True)
        worst = mrcal.projection_uncertainty(rays, model, atinfinity=True, what="worstdirection-stdev")
        record |= {
            "map_s": time.perf_counter() - wall,
            "map_cpu_s": time.process_time() - cpu,
            "map_px": worst.tolist(),
            "memory_mb": _memory_mb(),
        }
        print(json.dumps(record), flush=True)


if __name__ == "__main__":
    if len(sys.argv) != 2:
        raise SystemExit(__doc__)
    _work(sys.argv[1])
