"""A test field: 186 photographs of a board of 100 fixed points, ours beside mrcal, interleaved. See README.md.

python benchmarks/test_field.py --data FOLDER [--mrcal /usr/bin/python3] [--rounds 7] [--out DIR]
"""

import argparse
import dataclasses
import json
import os
import statistics
import subprocess
import tempfile
import time
from pathlib import Path

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("JAX_ENABLE_COMPILATION_CACHE", "false")

import jax
import numpy as np
import pandas as pd
from machine import HERE, machine, markdown, memory, sentence, write_results

import jaxphoto
from jaxphoto.adjustment import solve
from jaxphoto.block import Block
from jaxphoto.camera import Brown, InteriorOrientation, OpenCv, Sensor
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.procedures.calibration import CAMERA, Board, Detection, TargetRows, calibration_block
from jaxphoto.procedures.calibration.start import resected
from jaxphoto.rotation import small_rotation

SENSOR, SPACING_M, SIDE = Sensor(6016, 4016, 0.006), 0.077, 10
FORMAT, CELLS = (SENSOR.width_px, SENSOR.height_px), (60, 40)
FREE = ("c_mm", "xp_mm", "yp_mm", "b1", "k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
ORDER = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
# A camera told from the board itself (`calibrate`), and the model's nearest to it; it is 8 % off in c.
ROUGH = InteriorOrientation(13.4, 0.0, 0.0, Brown(k1=-1.58e-3, k2=-6.9e-6))
NEAREST = InteriorOrientation(13.4, 0.0, 0.0, OpenCv(k1=0.33, k2=0.046, k3=0.0013, k4=0.64, k5=0.093, k6=0.007))
# By how much a start nearby is off: a part of each number of the camera, metres, radians.
OFF = 1e-3


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True, help="the folder that holds mrcal_board")
    parser.add_argument("--mrcal", default="/usr/bin/python3", help="the interpreter that has mrcal")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--out", type=Path, help="folder for results.jsonl and results.md")
    arguments = parser.parse_args()
    records, lines = [], []
    corners = pd.read_csv(arguments.data / "mrcal_board" / "corners.csv")
    block = board_block(corners)
    for name in ("from afar", "nearby"):
        own = measure(block, corners, arguments.mrcal, arguments.rounds)
        records += [{"start": name, **r} for r in own]
        lines += [*table(name, own), ""]
        block = nearby(block)
    head = f"### A test field: 186 images of 100 fixed points\n\n{sentence(machine())}\n"
    write_results(arguments.out, "test_field", records, "\n".join([head, *lines]))


def board_block(corners: pd.DataFrame) -> Block:
    """The photographs of the board, each resected by itself to start with, without the corners that mrcal left out."""
    xyz = np.array([(SPACING_M * c, -SPACING_M * r, 0.0) for r in range(SIDE) for c in range(SIDE)])
    board = Board("mrcal", tuple(f"r{k // SIDE}c{k % SIDE}" for k in range(SIDE**2)), xyz, np.zeros(SIDE**2))
    detections = [
        # The centre of the upper left pixel is (0, 0) there.
        Detection(
            str(name),
            (SIDE * own.row + own.column).to_numpy(),
            own[["x_px", "y_px"]].to_numpy() + 0.5,
            np.repeat(1 / own.weight.to_numpy()[:, None], 2, axis=1),
        )
        for name, own in corners[corners.left_out_by_mrcal == 0].groupby("image")
    ]
    rows = TargetRows.of(detections, SENSOR)
    exterior, _ = resected(board, rows, ROUGH)
    return calibration_block(board, rows, SENSOR, NEAREST, exterior, FREE)


def nearby(block: Block) -> Block:
    """The same, to start near its optimum."""
    found, rng = solve(block, block.start.unknowns, block.priors).unknowns, np.random.default_rng(1)
    n, off = len(block.images), lambda v: v * (1 + OFF * rng.choice([-1.0, 1.0]))
    turns = [small_rotation(theta) for theta in rng.normal(0, OFF, (n, 3))]
    exterior = ExteriorOrientation(
        found.exterior.position + rng.normal(0, OFF, (n, 3)),
        np.stack([t @ r for t, r in zip(turns, found.exterior.camera_from_object, strict=True)]),
    )
    start = dataclasses.replace(found, interior=jax.tree.map(off, found.interior), exterior=exterior)
    return dataclasses.replace(block, start=dataclasses.replace(block.start, unknowns=start))


def write_for_mrcal(path: Path, block: Block, corners: pd.DataFrame) -> None:
    """The same corners and the same start as `mrcal_peer` reads them: y and the camera's z the other way round."""
    camera, exterior = block.start.unknowns.interior[CAMERA], block.start.unknowns.exterior
    flip, rotation = np.diag([1.0, -1.0, -1.0]), np.asarray(exterior.camera_from_object)
    place = {name: k for k, name in enumerate(block.images)}
    seen = np.full((len(place), SIDE, SIDE, 3), -1.0)
    weight = np.where(corners.left_out_by_mrcal == 1, -1.0, corners.weight)
    seen[corners.image.map(place), corners.row, corners.column] = np.stack([corners.x_px, corners.y_px, weight], axis=1)
    f = float(camera.c) / SENSOR.pixel_mm
    column, row = SENSOR.px_from_mm(np.array([float(camera.xp), float(camera.yp)])) - 0.5
    lens = camera.distortion
    np.savez(
        path,
        corners=seen,
        intrinsics=np.array([f * (1 + float(lens.b1)), f, column, row, *(float(getattr(lens, k)) for k in ORDER)]),
        rotation=flip @ rotation @ flip,
        translation=-np.einsum("ij,njk,nk->ni", flip, rotation, np.asarray(exterior.position)),
        spacing_m=SPACING_M,
        width_px=SENSOR.width_px,
        height_px=SENSOR.height_px,
    )


def measure(block: Block, corners: pd.DataFrame, interpreter: str, rounds: int) -> list[dict]:
    """One record a solve; ours first compiles, by itself."""
    began = time.perf_counter()
    adjusted = solve(block, block.start.unknowns, block.priors)
    between = time.perf_counter()
    jaxphoto.covariance(adjusted)
    first = {"first_call_s": between - began, "first_covariance_s": time.perf_counter() - between}
    jaxphoto.sigma_map(adjusted)
    records = []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "board.npz"
        write_for_mrcal(file, block, corners)
        command = [interpreter, str(HERE / "mrcal_peer.py"), str(file)]
        with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as peer:
            for _ in range(rounds):
                records += [_ours(block) | first, _theirs(peer)]
            assert peer.stdin is not None
            peer.stdin.close()
    return records


def _ours(block: Block) -> dict:
    wall, cpu = time.perf_counter(), time.process_time()
    adjusted = solve(block, block.start.unknowns, block.priors)
    between = time.perf_counter()
    record = {
        "solver": "jaxphoto",
        "solve_s": adjusted.seconds["solve"],
        "call_s": between - wall,
        # Of the whole call: making the index lists and the factor for statistics included.
        "cpu_s": time.process_time() - cpu,
        "steps": int(adjusted.steps),
        "square_sum": float(adjusted.sum_of_squares),
        "memory_mb": memory("VmHWM"),
    }
    between, cpu = time.perf_counter(), time.process_time()
    jaxphoto.covariance(adjusted)
    record |= {"covariance_s": time.perf_counter() - between, "covariance_cpu_s": time.process_time() - cpu}
    cells = np.stack(np.meshgrid(*(np.linspace(0.5, n - 0.5, m) for n, m in zip(FORMAT, CELLS, strict=True))), axis=-1)
    between, cpu = time.perf_counter(), time.process_time()
    found = jaxphoto.sigma_map(adjusted, points=SENSOR.mm_from_px(cells.reshape(-1, 2)))
    record |= {"map_s": time.perf_counter() - between, "map_cpu_s": time.process_time() - cpu}
    # mrcal takes the root mean square of the residuals, without regard to the redundancy.
    factor = np.sqrt(adjusted.redundancy / sum(adjusted.n_observations.values())) / SENSOR.pixel_mm
    return record | {"map_px": (factor * found.worst).tolist()}


def _theirs(peer: subprocess.Popen) -> dict:
    assert peer.stdin is not None
    assert peer.stdout is not None
    peer.stdin.write("solve\n")
    peer.stdin.flush()
    line = peer.stdout.readline()
    if not line:
        raise SystemExit("mrcal failed; its message is above (Debian: apt-get install mrcal python3-mrcal)")
    return json.loads(line)


def table(start: str, records: list[dict]) -> list[str]:
    """The records of one start as Markdown."""
    ours, theirs = ([r for r in records if r["solver"] == name] for name in ("jaxphoto", "mrcal"))
    best = min(r["square_sum"] for r in records)

    def cells(own: list[dict]) -> list[str]:
        median = lambda key: statistics.median(r[key] for r in own if key in r)  # noqa: E731
        ratio = lambda key: statistics.median(a[key] / b[key] for a, b in zip(own, theirs, strict=True))  # noqa: E731
        mine = own is ours
        return [
            own[0]["solver"],
            f"{1000 * median('solve_s'):.0f}",
            f"{ratio('solve_s'):.2f}",
            f"{1000 * median('cpu_s'):.0f}",
            f"{ratio('cpu_s'):.2f}",
            str(own[0]["steps"]) if mine else "-",
            f"{max(r['square_sum'] for r in own) / best - 1:.0e}",
            f"{1000 * median('covariance_s'):.0f} ({1000 * median('covariance_cpu_s'):.0f})" if mine else "-",
            f"{1000 * median('map_s'):.0f} ({1000 * median('map_cpu_s'):.0f})",
            f"{ratio('map_s'):.2f}",
            f"{np.abs(np.array(own[0]['map_px']) / theirs[0]['map_px'] - 1).max():.0e}",
            f"{own[0]['first_call_s']:.1f} + {own[0]['first_covariance_s']:.1f}" if mine else "-",
            f"{median('memory_mb'):.0f}",
        ]

    head = [f"start {start}", "solve ms", "ratio", "CPU of the whole call ms", "ratio", "steps"]
    head += ["square sum above the best", "all covariances ms (CPU)", "sigma map ms (CPU)", "ratio"]
    head += ["largest difference of a cell", "first call + covariance s", "memory MB"]
    return markdown(head, [cells(ours), cells(theirs)])


if __name__ == "__main__":
    main()
