"""Monte Carlo on disk: stream draws to Parquet, resume after an interruption, compare with the prediction."""

import dataclasses
import hashlib
import json
import time
from collections.abc import Callable, Generator
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pandas as pd

from jaxphoto.block import Block
from jaxphoto.devices import cores
from jaxphoto.io.draws_folder import DrawsFolder, digest_of
from jaxphoto.io.text_files import read_json
from jaxphoto.report.draws import LONG, draws_table, in_degrees, summary_table
from jaxphoto.report.page import versions
from jaxphoto.sensitivity import Bias, Readjustment
from jaxphoto.workers import in_parts
from jaxphoto.writing import whole_file

# Maximum size of a part in draws, components and image rows: an interrupted run loses one part (some seconds).
_PART, _PART_NUMBERS, _PART_ROWS = 4000, 5_000_000, 12_000_000
# Number of columns of the draws that are read at a time.
_AT_ONCE = 200
# Number of draws from which the kurtosis of an estimate is known well enough for the uncertainty of its standard
# deviation; fraction of the mean square below which a variance is rounding.
_LEAST_DRAWS, _ROUNDING = 100, 1e-18
# Columns of the draws that are not quantities.
_OF_DRAWS = ("draw", "converged", "iterations", "fallback")
# Maximum number of errors whose individual effects are predicted.
_PREDICTED = 20_000


class MonteCarlo:
    """Draws of `drawn` in the folder `directory`; `run` applies given errors.

    `precision`: relative precision of the standard deviations at which the run ends early.

    Raises InputError if the folder contains a different run or other files.
    """

    def __init__(
        self,
        block: Block,
        run: Readjustment,
        drawn: Bias,
        draws: int,
        seed: int,
        directory: Path,
        precision: float | None = None,
    ):
        self.title, self.run, self.drawn, self.seed = block.title, run, drawn, seed
        self.keys = jax.jit(jax.vmap(lambda k: drawn.drawn(jax.random.fold_in(jax.random.key(seed), k))))
        widest = len(drawn.names) + len(draws_table(run.first_order(np.zeros((1, len(drawn.names)))), run.adjusted).T)
        rows = len(run.adjusted.structure.image)
        part = run.part_size(min(_PART, _PART_NUMBERS // widest, _PART_ROWS // rows))
        settings = {
            "block": digest_of(block), "errors": _errors_line(drawn), "sigma": _sigma_line(drawn), "seed": seed,
            # Identify the distribution, which has no name, by its first draws.
            "first_draws": _digest(np.asarray(self.keys(np.arange(4)))),
            "exterior": run.exterior, "points": run.points, "thorough": run.many,
            "precision": precision, "versions": versions(),
        }  # fmt: skip
        self.folder = DrawsFolder(directory, settings, draws, part)
        self.computed, self.seconds, self.precision = 0, 0.0, precision
        # Sums of powers 0 to 4 of the differences of the estimates from the first draw.
        self._first: np.ndarray | None = None
        self._sums = np.zeros((5, 1))

    def draw(self, progress: Callable[[int], object] = lambda done: None, client: Any = None) -> None:
        """Draw the missing draws, on the workers of a `dask.distributed.Client` if given.

        `progress` is called with the number of draws. The run ends early if the relative `uncertainty` of the standard
        deviations, from all parts up to some part, is at most `precision`. Raises InputError if another process draws
        into the folder, and the errors of `in_parts`.
        """
        self.folder.fill(lambda missing: self._parts(missing, client), progress, self._precise)

    def _parts(self, missing: list[int], client: Any) -> Generator[tuple[int, pd.DataFrame], None, None]:
        if client is None:
            self.run.warm_up()
        began = time.perf_counter()
        for part, draws in in_parts(self.run, ((k, self._errors(k)) for k in missing), client, cores()):
            errors = zip(self.drawn.names, self._errors(part).T, strict=True) if self.drawn.recorded else ()
            draws = dataclasses.replace(draws, recorded=dict(errors))
            self.computed += len(draws.steps)
            self.seconds = time.perf_counter() - began
            yield part, draws_table(draws, self.run.adjusted, part * self.folder.per_part)

    def _precise(self, table: pd.DataFrame) -> bool:
        """Add the moments of a part. Return True if the standard deviations have the precision requested."""
        names = [name for name in table.columns if name not in _OF_DRAWS and not name.startswith((*LONG, "bias."))]
        values = table.loc[table["converged"], names].to_numpy(float)
        if len(values):
            # Differences from the first draw keep the digits of their powers.
            self._first = values[0] if self._first is None else self._first
            self._sums = self._sums + [((values - self._first) ** power).sum(axis=0) for power in range(5)]
        return self.precision is not None and self.uncertainty <= self.precision

    @property
    def uncertainty(self) -> float:
        """Largest standard deviation of a standard deviation of an estimate, relative to it.

        sqrt((kurtosis - 1) / 4 n) for n draws; infinite for few draws.
        """
        n, *sums = self._sums
        if n[0] < _LEAST_DRAWS:
            return np.inf
        m1, m2, m3, m4 = (each / n for each in sums)
        variance = m2 - m1**2
        fourth = m4 - 4 * m1 * m3 + 6 * m1**2 * m2 - 3 * m1**4
        changes = variance > _ROUNDING * (m1**2 + m2)
        kurtosis = fourth[changes] / variance[changes] ** 2
        return float(np.sqrt(np.maximum(kurtosis - 1, 0.0) / (4 * n[changes])).max(initial=0.0))

    @property
    def state(self) -> str:
        """Rate of the run and uncertainty of the standard deviations, in words."""
        known = f", standard deviations +- {100 * self.uncertainty:.2g} %" if self.uncertainty < 1 else ""
        return f" ({self.computed / self.seconds:.0f} per second{known})"

    def _errors(self, part: int) -> np.ndarray:
        """Draw the errors of a part. All parts have the same length here, so one program is compiled."""
        errors = np.asarray(self.keys(part * self.folder.per_part + np.arange(self.folder.per_part)))
        return errors[: self.folder.size(part)]

    def write(self) -> tuple[dict, pd.DataFrame]:
        """Write summary.csv, effects.csv and, last, summary.json; return the summary and its table.

        Existing files are read if nothing was drawn since they were written.
        """
        directory, folder = self.folder.directory, self.folder
        if self.computed == 0 and (directory / "summary.json").is_file():
            return read_json(directory / "summary.json"), pd.read_csv(directory / "summary.csv").fillna({"unit": ""})
        nominal, effects, predicted = self._prediction
        flags, names = folder.read(["converged", "fallback"]), [c for c in folder.columns() if c not in _OF_DRAWS]
        good, cameras = flags["converged"], self.run.adjusted.unknowns.interior
        predicted = predicted | {in_degrees(f"bias.{name}"): v for name, v in self._sigmas().items()}
        some = (pd.DataFrame(folder.read(names[k : k + _AT_ONCE]))[good] for k in range(0, len(names), _AT_ONCE))
        table = pd.concat([summary_table(c, nominal, predicted, cameras) for c in some], ignore_index=True)
        with whole_file(directory / "summary.csv") as work:
            table.to_csv(work, index=False)
        if len(effects):
            with whole_file(directory / "effects.csv") as work:
                effects.to_csv(work, index=False)
        summary = {
            "title": self.title, "draws": len(good), "converged": int(good.sum()),
            "fallbacks": int(flags["fallback"].sum()), "computed_now": self.computed,
            "seconds": {"compile": self.run.seconds["compile"], "draws": self.seconds},
            "draws_per_second": self.computed / self.seconds if self.seconds else 0.0, "versions": versions(),
        }  # fmt: skip
        with whole_file(directory / "summary.json") as work:
            work.write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
        return summary, table

    def _sigmas(self) -> dict[str, float]:
        """Return the standard deviation of each error by name, angles in degrees."""
        pairs = zip(self.drawn.names, self.drawn.sigma, strict=True)
        return {name: float(np.degrees(v) if name.endswith("_rad") else v) for name, v in pairs}

    @cached_property
    def _prediction(self) -> tuple[dict[str, float], pd.DataFrame, dict[str, float]]:
        """Return the nominal estimates, the effect of one sigma of each error on each, and their standard deviations.

        First order, for independent errors; empty if there are too many errors.
        """
        run, names = self.run, self.drawn.names
        nominal = draws_table(run.first_order(np.zeros((1, len(names)))), run.adjusted).iloc[0]
        quantities = [c for c in nominal.index if c not in _OF_DRAWS]
        at = nominal[quantities].to_numpy(float)
        values = dict(zip(quantities, at, strict=True))
        if len(names) > _PREDICTED:
            return values, pd.DataFrame(), {}
        squares, kept = np.zeros(len(quantities)), []
        for first in range(0, len(names), run.batch_size):
            some = np.arange(first, min(first + run.batch_size, len(names)))
            errors = np.zeros((len(some), len(names)))
            errors[np.arange(len(some)), some] = self.drawn.sigma[some]
            effect = draws_table(run.first_order(errors), run.adjusted)[quantities] - at
            squares += (effect.to_numpy() ** 2).sum(axis=0)
            if self.drawn.recorded:
                kept.append(effect)
        effects = pd.concat(kept, ignore_index=True) if kept else pd.DataFrame()
        if len(effects):
            effects.insert(0, "error", [in_degrees(name) for name in names])
            effects.insert(1, "sigma", list(self._sigmas().values()))
        return values, effects, dict(zip(quantities, np.sqrt(squares), strict=True))


def _errors_line(drawn: Bias) -> str:
    """Describe the errors in one line: their number, the quantities, and a digest of the assignment."""
    where = sorted({path[0] if path[0] != "start" else path[2] for path in drawn.targets})
    paths = (".".join(map(str, path)).encode() for path in drawn.targets)
    digest = _digest(*drawn.index, *(np.frombuffer(path, np.uint8) for path in paths))
    return f"{len(drawn.names)} of {', '.join(where)}, {digest[:12]}"


def _sigma_line(drawn: Bias) -> str:
    different = np.unique(drawn.sigma)
    values = ", ".join(f"{v:g}" for v in different[:4]) + (" ..." if len(different) > 4 else "")
    return f"{values}, {_digest(drawn.sigma)[:12]}"


def _digest(*arrays: np.ndarray) -> str:
    digest = hashlib.sha256()
    for array in arrays:
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
