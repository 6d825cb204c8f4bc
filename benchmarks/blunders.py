"""Blunders spoil a block; what `jaxphoto.snoop` finds of them, what it loses, and what that does to the camera.

python benchmarks/blunders.py [--block examples/cross_block] [--draws 20]
python benchmarks/blunders.py --problem P31 --cauchy    # a seeded block; and what Ceres with a Cauchy loss makes of it
"""

import argparse
import dataclasses
import itertools
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from blocks import SIZES, Problem, generate
from machine import HERE, machine, markdown, sentence, write_results
from ours import SIGN, block_of

import jaxphoto
from jaxphoto import Block, JaxphotoError, covariance, snoop
from jaxphoto.camera import get_parameter

# Sizes of the blunders in image points, in standard deviations.
_SIZES = 10.0, 1000.0
# Of the Cauchy loss: 95 % efficient where errors are normal.
_CAUCHY = 2.385
# A camera is as good as without the blunders within so many of its standard deviations.
_NEAR = 3.0


class Spoilt(NamedTuple):
    """A block with blunders: the rows that are wrong, by group."""

    block: Block
    wrong: frozenset[tuple[str, int]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--block", type=Path, default=HERE.parent / "examples" / "cross_block")
    parser.add_argument("--problem", choices=list(SIZES), help="a block of benchmarks/blocks.py instead")
    parser.add_argument(
        "--cauchy", action="store_true", help="with --problem: pyceres on the same blocks (pip install it)"
    )
    parser.add_argument("--draws", type=int, default=20, help="blocks of each kind")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, help="folder for results.jsonl and results.md")
    arguments = parser.parse_args()
    if arguments.cauchy and not arguments.problem:
        parser.error("--cauchy needs --problem: the peer knows no blocks but those")
    problem = generate(SIZES[arguments.problem]) if arguments.problem else None
    block = block_of(problem, arguments.problem) if problem else jaxphoto.read_block(arguments.block)
    clean = jaxphoto.adjust(block)
    peer = _Peer(problem, clean) if arguments.cauchy else None
    records: list[dict] = [{"kind": "head", **machine()}]
    for name, spoil in _cases(block).items():
        rng = np.random.default_rng(arguments.seed)
        for k in range(arguments.draws):
            spoilt = spoil(block, rng)
            of_peer = peer.tried(spoilt.block) if peer else {}
            records.append({"kind": "draw", "case": name, "draw": k, **_tried(spoilt, clean), **of_peer})
        print(_row(name, records), flush=True)
    titles = ["blunders", "blocks", "left out", "not left out", "sound rows left out", "gone with their point",
              f"camera within {_NEAR:g} sigma", "worst", "refused", "s a block"]  # fmt: skip
    titles += ["Ceres, Cauchy loss: camera within", "worst"] if peer else []
    given = f" --problem {arguments.problem}{' --cauchy' if peer else ''}" if problem else ""
    command = f"python benchmarks/blunders.py{given} --draws {arguments.draws} --seed {arguments.seed}"
    rows = [_row(name, records) for name in _cases(block)]
    lines = [
        f"### Blunders in {arguments.problem or arguments.block.name}",
        "",
        sentence(records[0]),
        "",
        f"`{command}`",
        "",
    ]
    write_results(arguments.out, "blunders", records, "\n".join([*lines, *markdown(titles, rows)]))


class _Peer:
    """Ceres with a Cauchy loss on every cost, on the same observations."""

    def __init__(self, problem: Problem, clean: jaxphoto.Adjustment) -> None:
        # Of those who ask for it: pyceres is no part of what jaxphoto needs.
        from pyceres_peer import robust_camera

        self.solve, self.problem = robust_camera, problem
        tested = jaxphoto.significance(clean, covariance(clean))
        self.expected = np.array([s.value for s in tested])
        self.sigma = np.array([s.sigma for s in tested])

    def tried(self, block: Block) -> dict:
        spoilt = dataclasses.replace(
            self.problem,
            obs_xy=np.asarray(block.image_points.xy),
            sta_obs=np.asarray(block.stations.value).reshape(-1, 3),
            gcp_obs=np.asarray(block.control.value).reshape(-1, 3),
        )
        camera = SIGN * self.solve(spoilt, _CAUCHY)
        return {"peer_off": float(np.max(np.abs(camera - self.expected) / self.sigma))}


def _cases(block: Block) -> dict[str, Callable[[Block, np.random.Generator], Spoilt]]:
    n = len(block.image_points)
    points = {"1": 1, "5": 5, "10": 10, "1 %": round(0.01 * n), "5 %": round(0.05 * n), "10 %": round(0.1 * n)}
    found = {f"{label} of image points": lambda b, rng, k=k: _image_points(b, rng, k) for label, k in points.items()}
    found["two names of an image exchanged"] = _exchanged
    found["two control points exchanged"] = lambda b, rng: _exchanged_coordinates(b, rng, "control_points")
    found["two stations exchanged"] = lambda b, rng: _exchanged_coordinates(b, rng, "stations")
    found["three control points in a circle"] = lambda b, rng: _reordered(
        b, "control_points", rng.choice(np.unique(b.control.who), 3, replace=False), closed=True
    )
    found["stations of eight images off by a row"] = lambda b, rng: _reordered(
        b, "stations", rng.integers(len(b.images) - 7) + np.arange(8), closed=False
    )
    found["heights of control in feet"] = lambda b, rng: _heights_in_feet(b, "control_points")
    found["control off by 1 m"] = lambda b, rng: _coordinate(b, rng, "control_points", 1.0)
    found["station off by 5 m"] = lambda b, rng: _coordinate(b, rng, "stations", 5.0)
    found["5 image points and a station"] = lambda b, rng: _both(b, rng)
    return found


def _image_points(block: Block, rng: np.random.Generator, n: int) -> Spoilt:
    p = block.image_points
    rows = rng.choice(len(p), n, replace=False)
    angle, size = rng.uniform(0, 2 * np.pi, n), np.exp(rng.uniform(*np.log(_SIZES), n))
    xy = np.array(p.xy)
    xy[rows] += size[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]) * np.asarray(p.sigma)[rows]
    return Spoilt(_with(block, p.group, xy=xy), frozenset((p.group, k) for k in rows.tolist()))


def _exchanged(block: Block, rng: np.random.Generator) -> Spoilt:
    p = block.image_points
    pair = rng.choice(np.flatnonzero(p.image == rng.integers(len(block.images))), 2, replace=False)
    xy = np.array(p.xy)
    xy[pair] = xy[pair[::-1]]
    return Spoilt(_with(block, p.group, xy=xy), frozenset((p.group, k) for k in pair.tolist()))


def _exchanged_coordinates(block: Block, rng: np.random.Generator, group: str) -> Spoilt:
    rows = block.named_observations[group]
    one, other = (np.flatnonzero(rows.who == k) for k in rng.choice(np.unique(rows.who), 2, replace=False))
    value = np.array(rows.observation)
    value[one], value[other] = value[other].copy(), value[one].copy()
    return Spoilt(_with(block, group, value=value), frozenset((group, int(k)) for k in (*one, *other)))


def _reordered(block: Block, group: str, who: np.ndarray, closed: bool) -> Spoilt:
    """Each gets the coordinates of the next; the last, of a circle that is `closed`, those of the first."""
    rows = block.named_observations[group]
    own = [np.flatnonzero(rows.who == k) for k in who]
    value = np.array(rows.observation)
    for here, there in itertools.pairwise([*own, own[0]] if closed else own):
        value[here] = np.asarray(rows.observation)[there]
    wrong = own if closed else own[:-1]
    return Spoilt(_with(block, group, value=value), frozenset((group, int(k)) for k in np.concatenate(wrong)))


def _heights_in_feet(block: Block, group: str) -> Spoilt:
    rows = block.named_observations[group]
    value = np.asarray(rows.observation) / np.where(rows.axis == 2, 0.3048, 1.0)
    # Near zero, a height is the same in feet.
    wrong = np.flatnonzero(np.abs(value - np.asarray(rows.observation)) > 10 * np.asarray(rows.sigma))
    return Spoilt(_with(block, group, value=value), frozenset((group, int(k)) for k in wrong))


def _coordinate(block: Block, rng: np.random.Generator, group: str, size: float) -> Spoilt:
    rows = block.named_observations[group]
    value = np.array(rows.observation)
    row = int(rng.integers(len(value)))
    value[row] += size * rng.choice([-1, 1])
    return Spoilt(_with(block, group, value=value), frozenset({(group, row)}))


def _both(block: Block, rng: np.random.Generator) -> Spoilt:
    points = _image_points(block, rng, 5)
    station = _coordinate(points.block, rng, "stations", 5.0)
    return Spoilt(station.block, points.wrong | station.wrong)


def _with(block: Block, group: str, **fields: np.ndarray) -> Block:
    rows = block.named_observations[group]
    return block.with_observations({group: dataclasses.replace(rows, **fields)})


def _tried(spoilt: Spoilt, clean: jaxphoto.Adjustment) -> dict:
    """What became of one spoilt block."""
    began = time.perf_counter()
    try:
        found = snoop(spoilt.block)
    except JaxphotoError as error:
        return {"refused": str(error), "seconds": time.perf_counter() - began}
    block, seconds = spoilt.block, time.perf_counter() - began
    left = {(s.group, s.row) for s in found.left_out}
    group = block.image_points.group
    gone = np.isin(block.image_points.point, [block.points.index(name) for name in found.points])
    gone_rows = {(group, k) for k in np.flatnonzero(gone).tolist()} - left
    right = {(e.group, k) for e in found.exchanged for pair in e.rows for k in pair}
    missed = spoilt.wrong - left - gone_rows - right
    return {
        "wrong": len(spoilt.wrong),
        "missed": len(missed),
        "innocent": len((left | right) - spoilt.wrong),
        "gone": len(gone_rows - spoilt.wrong),
        "off": _off(found.adjusted, clean),
        "sigma0": float(found.adjusted.sigma0),
        "seconds": seconds,
    }


def _off(adjusted: jaxphoto.Adjustment, clean: jaxphoto.Adjustment) -> float:
    """The largest difference of an interior parameter to that without blunders, over its standard deviation."""
    largest = 0.0
    for s in jaxphoto.significance(clean, covariance(clean)):
        value = float(get_parameter(adjusted.unknowns.interior[s.camera], s.parameter))
        largest = max(largest, abs(value - s.value) / s.sigma)
    return largest


def _row(name: str, records: list[dict]) -> list[str]:
    own = [r for r in records if r.get("case") == name]
    done = [r for r in own if "off" in r]
    total = lambda key: sum(r[key] for r in done)  # noqa: E731
    off = [r["off"] for r in done] or [np.nan]
    return [
        name, str(len(own)), str(total("wrong") - total("missed")), str(total("missed")), str(total("innocent")),
        str(total("gone")), f"{sum(v < _NEAR for v in off)} of {len(own)}", f"{max(off):.2f}",
        str(len(own) - len(done)), f"{np.median([r['seconds'] for r in own]):.2f}",
        *_of_peer([r["peer_off"] for r in own if "peer_off" in r]),
    ]  # fmt: skip


def _of_peer(off: list[float]) -> list[str]:
    return [f"{sum(v < _NEAR for v in off)} of {len(off)}", f"{max(off):.2f}"] if off else []


if __name__ == "__main__":
    main()
