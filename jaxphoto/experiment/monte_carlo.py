"""A Monte Carlo on disk: draws streamed to Parquet, continued where they stopped, summed up beside the prediction."""

import dataclasses
import json
import time
from collections.abc import Callable
from pathlib import Path

import jax
import numpy as np
import pandas as pd

from jaxphoto.block import Block
from jaxphoto.io.draws import DrawsFolder, digest_of, write_whole
from jaxphoto.report.draws import draws_figure, draws_table, effects_figure, moments, summary_table
from jaxphoto.report.results import versions, write_summary
from jaxphoto.sensitivity import Bias, Readjustment, joined_draws

# Draws of a part, which a run that is stopped loses at most.
_PART = 1000
# Errors of which the effect of each by itself is worth its time, and errors of a picture.
_PREDICTED, _PICTURED = 20_000, 60


class MonteCarlo:
    """Draws of `drawn` in the folder `directory`; `run` applies given errors.

    Raises InputError where the folder holds another run, or something else.
    """

    def __init__(self, block: Block, run: Readjustment, drawn: Bias, draws: int, seed: int, directory: Path):
        self.title, self.run, self.drawn, self.seed = block.title, run, drawn, seed
        settings = {
            "block": digest_of(block), "errors": list(drawn.names), "sigma": drawn.sigma.tolist(), "seed": seed,
            "exterior": run.exterior, "points": run.points, "batch": run.batch_size, "versions": versions(),
        }  # fmt: skip
        per_part = run.batch_size * -(-_PART // run.batch_size)
        self.folder = DrawsFolder(directory, settings, draws, per_part)
        self.computed, self.seconds = 0, 0.0

    def draw(self, progress: Callable[[int], object] = lambda done: None) -> None:
        """Draw what is missing; `progress` is told how many draws there are."""
        if self.folder.done:
            return
        folder = self.folder
        keys = jax.jit(jax.vmap(lambda k: self.drawn.drawn(jax.random.fold_in(jax.random.key(self.seed), k))))
        each = np.arange(folder.per_part)
        self.run.warm_up(np.asarray(keys(each)))
        began = time.perf_counter()
        for part in range(folder.next_part, folder.n_parts):
            # Always as many, so that they are compiled for once.
            numbers = part * folder.per_part + each
            errors, batches, done = np.asarray(keys(numbers))[numbers < folder.draws], [], int(numbers[0])
            for batch in self.run.batches(errors):
                batches.append(batch)
                done += len(batch.steps)
                progress(done)
            recorded = dict(zip(self.drawn.names, errors.T, strict=True)) if self.drawn.recorded else {}
            draws = dataclasses.replace(joined_draws(batches), recorded=recorded)
            folder.write_part(part, draws_table(draws, self.run.adjusted, int(numbers[0])))
            self.computed += len(errors)
        folder.join()
        self.seconds = time.perf_counter() - began

    def write(self) -> tuple[dict, pd.DataFrame]:
        """Write summary.csv, effects.csv, pictures and, last, summary.json; gives the summary and its table.

        Where all that was written before and nothing was drawn since, it is only read.
        """
        directory, folder = self.folder.directory, self.folder
        if self.computed == 0 and (directory / "summary.json").is_file():
            summary = json.loads((directory / "summary.json").read_text(encoding="utf-8"))
            return summary, pd.read_csv(directory / "summary.csv")
        nominal, effects, predicted = self._prediction()
        good = folder.column("converged")
        names = [c for c in folder.columns() if c not in ("draw", "converged", "iterations", "fallback")]
        predicted |= {f"bias.{name}".replace("_rad", "_deg"): v for name, v in self._sigmas().items()}
        table = summary_table({c: moments(folder.column(c)[good]) for c in names}, nominal, predicted)
        write_whole(directory / "summary.csv", lambda path: table.to_csv(path, index=False))
        pictured = {c: folder.column(c)[good] for c in self._shared_columns()}
        draws_figure(pictured, table).savefig(directory / "interior.png")
        if len(effects):
            effects.to_csv(directory / "effects.csv", index=False)
        if 0 < len(effects) <= _PICTURED:
            effects_figure(effects, table, list(pictured)).savefig(directory / "effects.png")
        summary = {
            "title": self.title,
            "draws": folder.draws,
            "converged": int(good.sum()),
            "fallbacks": int(folder.column("fallback").sum()),
            "computed_now": self.computed,
            "seconds": {"compile": self.run.seconds["compile"], "draws": self.seconds},
            "draws_per_second": self.computed / self.seconds if self.seconds else 0.0,
            "versions": versions(),
        }
        write_summary(summary, directory)
        return summary, table

    def _sigmas(self) -> dict[str, float]:
        """By name of the error, angles in degrees."""
        pairs = zip(self.drawn.names, self.drawn.sigma, strict=True)
        return {name: float(np.degrees(v) if name.endswith("_rad") else v) for name, v in pairs}

    def _shared_columns(self) -> list[str]:
        kept = ("bias.", "exterior.", "point.", "check.")
        names = self.folder.columns()
        return [c for c in names if not c.startswith(kept) and c not in ("draw", "converged", "iterations", "fallback")]

    def _prediction(self) -> tuple[dict[str, float], pd.DataFrame, dict[str, float]]:
        """The nominal estimates; what one sigma of each error does to each; and the standard deviations of that.

        To first order, for errors that are independent of one another; empty where these are too many.
        """
        run, names = self.run, self.drawn.names
        nominal = draws_table(run.first_order(np.zeros((1, len(names)))), run.adjusted).iloc[0]
        quantities = [c for c in nominal.index if c not in ("draw", "converged", "iterations", "fallback")]
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
            effects.insert(0, "error", [name.replace("_rad", "_deg") for name in names])
            effects.insert(1, "sigma", list(self._sigmas().values()))
        return values, effects, dict(zip(quantities, np.sqrt(squares), strict=True))
