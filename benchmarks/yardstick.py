"""Numerical reference: what the adjustments of this checkout give, compared with values stored in the repository.

python benchmarks/yardstick.py store [CASE ...]
python benchmarks/yardstick.py compare [CASE ...] [--limit 1e-9]

`store` writes benchmarks/yardstick/CASE.npz; `compare` computes the same with this checkout, prints the largest
difference by case and kind, and ends with status 1 where one exceeds its limit. README.md explains units and limits.
"""

import argparse
import dataclasses
import os
import sys
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]
# Most of the time is compilation, and most of that is optimisation. What is compiled serves the next run.
os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0 --xla_cpu_parallel_codegen_split_count=1")
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")

import jax
import numpy as np
from optimum import Values, differences, optimum, sigmas_of, unknowns_of, worst
from yardstick_blocks import CASES, NoDataError

from jaxphoto import Block, adjust, covariance
from jaxphoto.adjustment import MINIMAL_SIZES, TOLERANCE, PaddedSizes, common_sizes
from jaxphoto.sensitivity import monte_carlo, noise, response, sensitivity
from jaxphoto.statistics import correlation_matrix, redundancy_numbers

FOLDER = HERE / "yardstick"
DRAWS, SEED = 2, 50
# Of each array as many rows are stored, evenly spaced; of draws and tangents fewer.
_MOST, _DRAWN = 150, 40
# Derivatives are stored of blocks with images, as many of these and of shared unknowns at most.
_SMALL = 70, 300
# Cases of which the programs for Monte Carlo and tangents are compared, too: these take longest to compile.
MAPPED = ("cross_block",)


def _chosen(values: np.ndarray, most: int = _MOST) -> np.ndarray:
    """Rows, `most` at most, evenly spaced."""
    n = len(values)
    return values if n <= most else values[np.linspace(0, n - 1, most).round().astype(int)]


def _drawn(values: np.ndarray) -> np.ndarray:
    """Fewer of the same rows."""
    return _chosen(_chosen(values), _DRAWN)


def _concrete(tree):
    return jax.tree.map(lambda v: np.asarray(v) if isinstance(v, jax.Array) else v, tree)


def _sums(values: np.ndarray) -> np.ndarray:
    """Sums of the columns with random signs, over the root of their length: one differs where any number does."""
    signs = np.random.default_rng(SEED).choice([-1.0, 1.0], (3, len(values)))
    return signs @ values / np.sqrt(max(len(values), 1))


def measure(block: Block, sizes: PaddedSizes, whole: bool, mapped: bool) -> Values:
    """What is stored of a block, by kind and part: draws and derivatives of the `whole`, other programs of `mapped`."""
    adjusted = optimum(block, sizes=sizes)
    block, u, priors = adjusted.block, adjusted.unknowns, adjusted.priors
    known = covariance(adjusted, "camera", rows=True)
    first, labels = 6 * known.n_images, np.array(known.labels[6 * known.n_images :], str)
    # Cameras first and by name, whatever their order in this checkout.
    cameras = [label.partition(".")[0] if label.startswith("interior[") else "~" for label in labels]
    order = np.argsort(cameras, kind="stable").astype(int)
    every = np.append(np.arange(first), first + order).astype(int)
    rho, sigmas = correlation_matrix(known)[np.ix_(every, every)], sigmas_of(known)
    covariances = np.asarray(known.points)
    root = np.sqrt(np.maximum(np.diagonal(covariances, axis1=1, axis2=2), 0))
    scale = np.where(root > 0, root, np.inf)
    of_points = covariances / scale[:, :, None] / scale[:, None, :]
    numbers = [np.ravel(v) for rows in (block.image_points, *block.observations)
               for v in jax.tree.leaves(rows) if np.asarray(v).dtype.kind == "f" and np.isfinite(v).all()]  # fmt: skip
    values: Values = {
        "input": np.stack([_sums(v) / max(np.abs(v).max(initial=0.0), 1e-300) for v in numbers]),
        "sigma0": np.array([float(adjusted.sigma0)]),
        "correlations.shared": _chosen(rho[first:].ravel(), 3 * _MOST),
        "correlations.all": _chosen(_sums(rho).T),
        "correlations.points": _chosen(of_points[:, [0, 0, 1], [1, 2, 2]]),
    }
    sorted_sigmas = sigmas | {"shared": sigmas["shared"][order]}
    for name, value in unknowns_of(adjusted, labels[order]).items():
        values[f"unknowns.{name}"], values[f"sigmas.{name}"] = _chosen(value), _chosen(sorted_sigmas[name])
    for name, value in redundancy_numbers(adjusted, known).named.items():
        if np.size(value):
            values[f"redundancy.{name}"] = _chosen(np.asarray(value).reshape(-1, np.shape(value)[-1]).T)
    if not whole:
        return values
    if 0 < len(block.images) <= _SMALL[0] and len(known.labels) - first <= _SMALL[1]:
        for name, value in sensitivity(adjusted).named.items():
            flat = np.asarray(value).reshape(len(value), int(np.prod(np.shape(value)[1:])))
            images = np.linspace(0, first - 1, 6 if first else 0).astype(int)
            rows = np.append(images, every[first:][:10])
            values[f"derivatives.{name}"] = _chosen(flat[rows].T, 24)
    start = dataclasses.replace(block.start, unknowns=u, image_known=np.ones(len(block.images), bool),
                                point_known=np.ones(len(block.points), bool))  # fmt: skip
    nominal = dataclasses.replace(block, start=start, priors=priors)
    errors = noise(nominal)
    keys = [jax.random.fold_in(jax.random.key(SEED), k) for k in range(DRAWS)]
    for k, key in enumerate(keys):
        drawn = _concrete(errors.applied(errors.drawn(key), nominal))
        found = optimum(drawn, u, drawn.priors, sizes, sigmas)
        for name, value in unknowns_of(found, labels[order]).items():
            values[f"draws.{k}.{name}"] = _drawn(value)
    if mapped:
        many = monte_carlo(adjusted, errors, DRAWS, SEED, exterior=True, points=True)
        for k in range(DRAWS):
            values[f"monte carlo.{k}.shared"] = _drawn(many.shared[k][order])
            values[f"monte carlo.{k}.position"] = _drawn(many.exterior[k, :, :3])
            values[f"monte carlo.{k}.points"] = _drawn(many.points[k])
        step = errors.drawn(keys[0])
        changed = _concrete(errors.applied(step, nominal))
        moved = response(adjusted, changed, priors=changed.priors).unknowns
        values["tangents.points"] = _drawn(np.asarray(moved.points))
        along = lambda t: errors.applied(t * step, nominal)  # noqa: E731
        _, moved = jax.jvp(lambda t: adjust(along(t), u, along(t).priors).unknowns.points, (0.0,), (1.0,))
        values["jvp.points"] = _drawn(np.asarray(moved))
    return values


# Draws of `monte_carlo` are solved to the solver's tolerance only.
LIMITS = {"monte carlo": TOLERANCE, "input": 1e-12}
# Units of the last digit by which a coordinate may differ.
_LAST_DIGITS = 4
# Parts that are not stored, because they are to equal others.
_SAME = {"monte carlo": "draws", "jvp": "tangents"}


def compared(now: Values, then: Values) -> Iterator[tuple[str, str, float]]:
    """Yield kind, part and largest difference of each array, in the unit of its kind."""
    sigmas = {part.partition(".")[2]: v for part, v in then.items() if part.startswith("sigmas.")}
    for part in dict.fromkeys([*then, *now]):
        kind, _, name = part.partition(".")
        new, old = now.get(part), then.get(f"{_SAME[kind]}.{name}" if kind in _SAME else part)
        name = name.rpartition(".")[2]
        if new is None or old is None or new.shape != old.shape:
            yield kind, part, np.inf
        elif kind in ("unknowns", "draws", "monte carlo"):
            sigma = _chosen(sigmas[name], len(old))
            off, sigma = differences({name: new}, {name: old}, {name: sigma})[name]
            if name != "rotation":
                # Large coordinates are no finer.
                off = np.maximum(np.abs(off) - _LAST_DIGITS * np.spacing(np.abs(old)), 0)
            yield kind, part, worst(off, sigma)
        elif kind in ("tangents", "jvp"):
            yield kind, part, worst(new - old, _chosen(sigmas[name], len(old)))
        elif kind in ("sigma0", "sigmas"):
            yield kind, part, worst(new - old, old)
        elif kind == "derivatives":
            yield kind, part, worst(new - old, np.broadcast_to(np.abs(old).max(axis=0), old.shape))
        else:
            yield kind, part, worst(new - old, np.ones(old.shape))


def blocks_of(name: str) -> Iterator[tuple[str, Values]]:
    """Measure every block of a case; those of as many images share what is compiled."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        blocks = CASES[name]()
        alike: dict[int, list[Block]] = {}
        for block in blocks.values():
            alike.setdefault(len(block.images), []).append(block)
        for k, (title, block) in enumerate(blocks.items()):
            same = alike[len(block.images)]
            sizes = common_sizes(same) if len(same) > 1 else MINIMAL_SIZES
            yield title, measure(block, sizes, k == 0, k == 0 and name in MAPPED)


def store(names: list[str], folder: Path = FOLDER) -> int:
    """Write what this checkout gives; 1 where a case fails."""
    folder.mkdir(exist_ok=True)
    failed = 0
    for name in names:
        began = time.process_time()
        try:
            measured = [(title, part, v) for title, values in blocks_of(name) for part, v in values.items()]
        except NoDataError as error:
            print(f"{name}: skipped, {error}", flush=True)
            continue
        except Exception as error:
            print(f"{name}: failed, {type(error).__name__}: {error}", flush=True)
            failed += 1
            continue
        stored = {f"{title}|{part}": v for title, part, v in measured if part.partition(".")[0] not in _SAME}
        np.savez_compressed(folder / f"{name}.npz", **stored)
        size = (folder / f"{name}.npz").stat().st_size / 1e3
        print(f"{name}: {size:.0f} kB, {time.process_time() - began:.0f} s of CPU", flush=True)
    return int(failed > 0)


def differences_of(name: str, folder: Path) -> dict[str, tuple[float, str]]:
    """By kind the largest difference of a case, and where it is."""
    with np.load(folder / f"{name}.npz") as file:
        stored = dict(file)
    found: dict[str, tuple[float, str]] = {}
    for title, values in blocks_of(name):
        then = {part.partition("|")[2]: v for part, v in stored.items() if part.startswith(f"{title}|")}
        for kind, part, off in compared(values, then):
            found[kind] = max(found.get(kind, (-1.0, "")), (off, f"{title}, {part}"))
    return found


def compare(names: list[str], limit: float, folder: Path = FOLDER) -> int:
    """Print the largest differences from what is stored; 1 where one exceeds its limit."""
    largest: dict[str, tuple[float, str]] = {}
    for name in names:
        began = time.process_time()
        try:
            found = differences_of(name, folder)
        except NoDataError as error:
            print(f"{name}: skipped, {error}", flush=True)
            continue
        except Exception as error:
            found = {"failed": (np.inf, f"{type(error).__name__}: {error}")}
        print(f"{name} ({time.process_time() - began:.0f} s of CPU)", flush=True)
        for kind, (off, where) in found.items():
            mark = "  EXCEEDS THE LIMIT" if off > LIMITS.get(kind, limit) else ""
            print(f"    {kind:<13}{off:9.1e}  {where}{mark}", flush=True)
            largest[kind] = max(largest.get(kind, (-1.0, "")), (off, f"{name}: {where}"))
    print("\nlargest differences (limits)")
    for kind, (off, where) in largest.items():
        print(f"    {kind:<13}{off:9.1e} ({LIMITS.get(kind, limit):.0e})  {where}")
    return int(any(off > LIMITS.get(kind, limit) for kind, (off, _) in largest.items()))


def main() -> int:
    """Store or compare the cases named, or all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("command", choices=("store", "compare"))
    parser.add_argument("cases", nargs="*", metavar="CASE", help=", ".join(CASES))
    parser.add_argument("--limit", type=float, default=1e-9, help="largest difference allowed")
    given = parser.parse_args()
    if unknown := set(given.cases) - set(CASES):
        parser.error(f"no case {', '.join(sorted(unknown))}: choose from {', '.join(CASES)}")
    names = given.cases or list(CASES)
    return store(names) if given.command == "store" else compare(names, given.limit)


if __name__ == "__main__":
    sys.exit(main())
