"""Several devices and processes give the optimum and statistics of one device.

Devices are configured before JAX computes, so each case runs in a subprocess (`main`).
"""

import dataclasses
import functools
import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from unittest import mock

import jax
import numpy as np
import pytest

import jaxphoto
from jaxphoto.adjustment import Adjustment, adjust
from jaxphoto.adjustment.layout import padding
from jaxphoto.block import Block
from jaxphoto.devices import mesh_of, usable
from jaxphoto.observations import Distances
from jaxphoto.statistics.reliability import redundancy_numbers
from tests import declared
from tests.blocks import free_network, from_afar, simulated
from tests.levelling import HeightDifferences
from tests.marks import slow_but

ROOT = Path(__file__).resolve().parents[2]
BLOCKS = {
    "two_cameras": lambda: simulated("two_cameras").block,
    # Surfaces meet shared unknowns.
    "surfaces": lambda: simulated("surfaces").block,
    # The constraints of the datum go over all points, and what it ends at is brought to them as a whole.
    "afar": lambda: from_afar(network := free_network(), network.start.unknowns),
    "declared": lambda: _without_coupled(declared.simulated().block),
}
# Seconds, mostly compilation.
PATIENCE = 300
ADDRESS, PROCESS = "JAXPHOTO_TEST_ADDRESS", "JAXPHOTO_TEST_PROCESS"


def _without_coupled(block: Block) -> Block:
    """All that is declared but rows that couple points: a block with these stays on one device."""
    more = tuple(rows for rows in block.more if not isinstance(rows, HeightDifferences))
    return dataclasses.replace(block, distances=Distances.none(), more=more)


def numbers_of(result: Adjustment) -> dict[str, np.ndarray]:
    """Unknowns, their covariances, residuals and redundancy numbers."""
    cofactors = jaxphoto.covariance(result, "camera")
    redundancy = redundancy_numbers(result, cofactors)
    unknowns = result.unknowns
    found = {
        "position": unknowns.exterior.position,
        "rotation": unknowns.exterior.camera_from_object,
        "points": unknowns.points,
        "interior": np.array(jax.tree.leaves(unknowns.interior)),
        "mounts": np.concatenate([np.zeros(0), *map(np.ravel, jax.tree.leaves(unknowns.mounts))]),
        "square_sum": result.sum_of_squares,
        "steps": result.steps,
        "matrix": cofactors.matrix,
        "point_covariances": cofactors.points,
    }
    for name, of in (("residual", result.residuals), ("redundancy", redundancy)):
        found |= {f"{name}_{group}": values for group, values in of.named.items()}
    return {name: np.asarray(values) for name, values in found.items()}


@functools.cache
def on_one_device(name: str) -> dict[str, np.ndarray]:
    block = BLOCKS[name]()
    return numbers_of(jaxphoto.adjust(block, block.start.unknowns))


def main(cases: str, folder: str) -> None:
    """Adjust blocks on numbers of devices (name:number,...), after joining other processes if there are any."""
    process = int(os.environ.get(PROCESS, "0"))
    if ADDRESS in os.environ:
        jax.distributed.initialize(os.environ[ADDRESS], num_processes=2, process_id=process, initialization_timeout=60)
    for name, n in (case.split(":") for case in cases.split(",")):
        block = BLOCKS[name]()
        # So small a block would be left to one device.
        # Small batches, of which each device has several.
        small = mock.patch.multiple(padding, _RAYS=128, _PAIRS=128, _FEWEST=128)
        with small, mock.patch.object(adjust, "_devices_worth_using", lambda rows, n=n: usable(int(n))):
            result = jaxphoto.adjust(block, block.start.unknowns)
        assert result.outcome is jaxphoto.Outcome.CONVERGED
        held = result.equations.structure.rays.shards
        np.savez(Path(folder) / f"{name}_{n}_{process}.npz", shards=held, **numbers_of(result))


def run_all(cases: str, folder: Path, devices: int, environments: list[dict[str, str]]) -> None:
    """`main` in a process of `devices` devices for each of `environments`, to the end; what they say if one fails."""
    flags = f"{os.environ.get('XLA_FLAGS', '')} --xla_force_host_platform_device_count={devices}"
    command = [sys.executable, "-m", "tests.adjustment.test_shards", cases, str(folder)]
    logs = [folder / f"{k}.log" for k in range(len(environments))]
    processes = []
    try:
        for log, environment in zip(logs, environments, strict=True):
            with log.open("w") as file:
                own = os.environ | {"XLA_FLAGS": flags} | environment
                processes.append(subprocess.Popen(command, cwd=ROOT, env=own, stdout=file, stderr=subprocess.STDOUT))
        end = time.monotonic() + PATIENCE
        # Where one fails the others would wait for it.
        while any(p.poll() is None for p in processes) and not any(p.returncode for p in processes):
            assert time.monotonic() < end, "\n\n".join(log.read_text() for log in logs)
            time.sleep(0.1)
    finally:
        for process in processes:
            process.kill()
            process.wait()
    codes = [process.returncode for process in processes]
    assert not any(codes), f"exit codes {codes}\n" + "\n\n".join(log.read_text() for log in logs)


def assert_same(found: dict[str, np.ndarray], name: str) -> None:
    """The same adjustment as on one device, but for rounding."""
    wanted = on_one_device(name)
    assert found.keys() == wanted.keys() | {"shards"}
    for key, values in wanted.items():
        size = np.abs(values).max(initial=0.0)
        np.testing.assert_allclose(found[key], values, rtol=0, atol=1e-10 * size, err_msg=key)
    sigma = np.sqrt(np.diagonal(wanted["point_covariances"], axis1=1, axis2=2))
    assert np.abs((found["points"] - wanted["points"]) / sigma).max() < 1e-6


# Two and three devices, each once with every kind of block: a case compiles for ten seconds.
CASES = [("two_cameras", 3), ("surfaces", 2), ("afar", 3), ("declared", 2)]


@pytest.mark.parametrize("case", slow_but([("surfaces", 2)], CASES))
def test_several_devices_find_the_same(tmp_path: Path, case: tuple[str, int]) -> None:
    name, shards = case
    run_all(f"{name}:{shards}", tmp_path, 3, [{}])
    found = dict(np.load(tmp_path / f"{name}_{shards}_0.npz"))
    assert found["shards"] == shards
    assert_same(found, name)


@pytest.mark.slow
def test_two_processes_find_the_same(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"
    # Of three devices wanted, two can be equally many of each process.
    run_all("two_cameras:3", tmp_path, 2, [{ADDRESS: address, PROCESS: str(k)} for k in range(2)])
    for process in range(2):
        found = dict(np.load(tmp_path / f"two_cameras_3_{process}.npz"))
        assert found["shards"] == 2
        assert_same(found, "two_cameras")


class Device:
    def __init__(self, process_index: int):
        self.process_index = process_index


@pytest.mark.parametrize(("wanted", "used"), [(0, 1), (1, 1), (2, 2), (3, 2), (4, 4), (7, 4)])
def test_as_many_devices_of_each_process(monkeypatch: pytest.MonkeyPatch, wanted: int, used: int) -> None:
    monkeypatch.setattr(jax, "process_count", lambda: 2)
    monkeypatch.setattr(jax, "devices", lambda: [Device(0)] * 3 + [Device(1)] * 2)
    assert usable(wanted) == used


def test_a_process_alone_takes_its_first_devices() -> None:
    assert usable(1) == usable(0) == 1
    assert usable(10_000) == jax.device_count()
    assert mesh_of(1).devices.tolist() == jax.devices()[:1]


def test_large_blocks_are_worth_several_devices() -> None:
    assert adjust._devices_worth_using(1000) == 1
    assert adjust._devices_worth_using(10**9) == jax.device_count()


if __name__ == "__main__":
    main(*sys.argv[1:])
