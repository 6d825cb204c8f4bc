"""Experiments: variants of simulated blocks, adjusted for several layouts and compared with the tables of a paper."""

import dataclasses
import importlib.util
import io
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from jaxphoto.adjustment import PaddedSizes, common_sizes
from jaxphoto.block import Block
from jaxphoto.errors import InputError, JaxphotoError
from jaxphoto.io.recipe import recipe_from
from jaxphoto.io.text_files import read_text
from jaxphoto.io.toml import read_toml
from jaxphoto.procedures.adjust import adjust
from jaxphoto.report import Tables
from jaxphoto.simulation import Recipe, Simulation, simulate
from jaxphoto.workers import in_parts

FILE = "experiment.py"
Progress = Callable[[str], None]
MEAN_DIFFERENCE = "mean_abs_difference"
"""Name of the column whose cell is the mean of |ours - published| over its table."""
_KEY = ["table", "row", "column"]
PUBLISHED = [*_KEY, "published", "unit", "tolerance", "note"]
COLUMNS = [
    "paper", *_KEY, "published", "ours", "unit", "tolerance", "within", "note", "spread", "n_layouts",
]  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Results(Mapping[str, Tables]):
    """Adjusted variants of one layout, by name. `simulations` contains their blocks before `Variant.change`."""

    adjusted: Mapping[str, Tables]
    simulations: Mapping[str, Simulation]

    def __getitem__(self, variant: str) -> Tables:
        return self.adjusted[variant]

    def __iter__(self) -> Iterator[str]:
        return iter(self.adjusted)

    def __len__(self) -> int:
        return len(self.adjusted)


Cells = dict[tuple[str, str], float]
"""Values of one table, by row and column name."""
Measure = Callable[[Results], Cells]


@dataclasses.dataclass(frozen=True)
class Variant:
    """One adjustment: `change` applied to the block of the recipe, with the keys of `recipe` replaced.

    `recipe` is nested like the TOML file: `{"cameras": {"kodak": {"truth": {"c_mm": 35.5}}}}`.
    """

    change: Callable[[Block], Block] = lambda block: block
    recipe: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    file: str = "recipe.toml"
    """Name of the recipe file, in the folder of experiment.py."""


@dataclasses.dataclass(frozen=True)
class Experiment:
    """Variants of simulated blocks, and the tables computed from them.

    For each of `layouts` random layouts (seeds 0, 1, ...) every variant is simulated and adjusted. The cells of every
    table are means over the layouts. `published.csv`, in the folder of experiment.py, contains the values of a paper,
    if there is one.
    """

    title: str
    variants: Mapping[str, Variant]
    tables: Mapping[str, Measure]
    layouts: int = 10
    paper: str = ""


@dataclasses.dataclass(frozen=True)
class Run:
    """Results of an experiment: the cells of every layout, the adjustments of the first layout, and failures.

    `cells` has the columns table, row, column, layout, value.
    """

    experiment: Experiment
    cells: pd.DataFrame
    first: Mapping[str, Tables]
    failures: tuple[str, ...]


def run_experiment(
    experiment: Experiment,
    folder: Path,
    layouts: int | None = None,
    progress: Progress = lambda _: None,
    client: Any = None,
) -> Run:
    """Run `experiment` with the recipes in `folder`. `progress` is called with a message for every step.

    `client`: a `dask.distributed.Client`, whose workers adjust the layouts after the first (docs/cluster.md). A layout
    in which a variant cannot be simulated or adjusted is rejected and listed in `failures`. Raises InputError if all
    layouts are rejected, and for recipes that cannot be read.
    """
    recipes = {name: _recipe(variant, folder) for name, variant in experiment.variants.items()}
    failures: list[str] = []
    simulations: dict[int, dict[str, Simulation]] = {}
    wanted = layouts or experiment.layouts
    for layout in range(wanted):
        progress(f"simulating layout {layout + 1} of {wanted}")
        try:
            simulations[layout] = _simulated(experiment, recipes, layout)
        except (JaxphotoError, ValueError) as error:
            failures.append(f"layout {layout}: {error}")
    sizes = _sizes([{name: s.block for name, s in variants.items()} for variants in simulations.values()])
    study, first = _Layouts(experiment.tables, sizes), dict[str, Tables]()
    found: dict[int, Any] = {}
    for layout, variants in simulations.items():
        progress(f"adjusting layout 1 of {len(simulations)}")
        first, *of_first = study.adjusted(variants)
        found[layout] = tuple(of_first)
        if first:
            break
    others = ((layout, variants) for layout, variants in simulations.items() if layout not in found)
    for layout, result in in_parts(study, others, client):
        found[layout] = result
        progress(f"adjusting: layout {len(found)} of {len(simulations)}")
    failures += [f"layout {layout}, {found[layout][1]}" for layout in simulations if found[layout][1]]
    if not first:
        raise InputError(f"{folder}: no layout could be adjusted; first error: {failures[0]}")
    rows = [(*key, layout, value) for layout in simulations for *key, value in found[layout][0]]
    cells = pd.DataFrame(rows, columns=["table", "row", "column", "layout", "value"])
    return Run(experiment, cells, first, tuple(failures))


class _Layouts(NamedTuple):
    """Adjustment and evaluation of simulated layouts; a study of `in_parts`."""

    tables: Mapping[str, Measure]
    sizes: Mapping[str, PaddedSizes]

    def compute(self, part: Mapping[str, Simulation]) -> tuple[list[tuple], str]:
        """Return the cells (table, row, column, value) of a layout, and the reason if it is rejected."""
        return self.adjusted(part)[1:]

    def adjusted(self, variants: Mapping[str, Simulation]) -> tuple[dict[str, Tables], list[tuple], str]:
        """Return the adjustments of all variants, and the result of `compute`; no adjustments if one fails."""
        adjusted = dict[str, Tables]()
        try:
            for name, simulation in variants.items():
                adjusted[name] = Tables(adjust(simulation.block, sizes=self.sizes[name]))
                if not bool(adjusted[name].adjusted.converged):
                    raise InputError(adjusted[name].adjusted.outcome.value)
        except JaxphotoError as error:
            return {}, [], f"{name}: {error}"
        results = Results(adjusted, variants)
        rows = [(table, *key, value) for table, of in self.tables.items() for key, value in of(results).items()]
        return adjusted, rows, ""


def simulated(experiment: Experiment, folder: Path, variant: str, layout: int = 0) -> Simulation:
    """Simulate one variant without `Variant.change`; return block and true parameters."""
    return simulate(_recipe(experiment.variants[variant], folder), layout)


def _simulated(experiment: Experiment, recipes: Mapping[str, Recipe], layout: int) -> dict[str, Simulation]:
    """Simulate each variant; variants of one recipe share the simulation."""
    simulations: dict[tuple[str, str], Simulation] = {}
    variants = {}
    for name, variant in experiment.variants.items():
        key = (variant.file, repr(variant.recipe))
        if key not in simulations:
            simulations[key] = simulate(recipes[name], layout)
        variants[name] = dataclasses.replace(simulations[key], block=variant.change(simulations[key].block))
    return variants


def _sizes(layouts: list[dict[str, Block]]) -> dict[str, PaddedSizes]:
    """Return the padded sizes by variant: variants and layouts with equal numbers of images share compiled programs."""
    of_images: dict[int, list[Block]] = {}
    for block in (b for variants in layouts for b in variants.values()):
        of_images.setdefault(len(block.images), []).append(block)
    sizes = {n: common_sizes(blocks) for n, blocks in of_images.items()}
    return {name: sizes[len(block.images)] for name, block in layouts[0].items()} if layouts else {}


def _recipe(variant: Variant, folder: Path) -> Recipe:
    def merged(values: Any, changes: Any) -> Any:
        if not isinstance(values, Mapping) or not isinstance(changes, Mapping):
            return changes
        return {**values, **{key: merged(values.get(key, {}), change) for key, change in changes.items()}}

    path = folder / variant.file
    if not path.is_file():
        raise InputError(f"recipe not found: {path}; add it, or correct the variant's file")
    return recipe_from(merged(read_toml(path), variant.recipe), f"{folder.name}/{variant.file}")


def summary(cells: pd.DataFrame) -> pd.DataFrame:
    """Compute mean and standard deviation of every cell over the layouts.

    Columns: table, row, column, ours, spread, n_layouts.
    """
    groups = cells.groupby(["table", "row", "column"], sort=False)["value"]
    # Subtract the first layout: equal cells then give exactly their value and zero spread.
    table = groups.agg(
        ours=lambda v: v.iloc[0] + np.mean(v - v.iloc[0]),
        spread=lambda v: np.std(v - v.iloc[0], ddof=1) if len(v) > 1 else np.nan,
        n_layouts="size",
    )
    return table.reset_index()


def read_published(folder: Path) -> pd.DataFrame:
    """Read the published cells; empty without published.csv. Raises InputError for a missing column."""
    path = folder / "published.csv"
    if not path.is_file():
        return pd.DataFrame(columns=PUBLISHED)
    table = pd.read_csv(
        io.StringIO(read_text(path)),
        dtype={"row": str, "column": str, "note": str},
        keep_default_na=False,
        na_values=[""],
    )
    if missing := [name for name in PUBLISHED if name not in table.columns]:
        raise InputError(f"{path}: the column {missing[0]} is missing; add it ({', '.join(PUBLISHED)} are needed)")
    for first in table[table.duplicated(_KEY)][_KEY].itertuples(index=False):
        raise InputError(f"{path}: {', '.join(first)} is printed twice; keep one row")
    return table


def compare(run: Run, folder: Path) -> pd.DataFrame:
    """Return the table tables.csv: every published or computed cell. `within` is yes or no if there is a tolerance.

    `ours` is the mean over `n_layouts` layouts, `spread` the standard deviation over the layouts.
    """
    published = read_published(folder)
    table = published.merge(summary(run.cells), on=_KEY, how="left")
    ours = summary(run.cells).merge(published[_KEY], on=_KEY, how="left", indicator=True)
    table = pd.concat([table, ours[ours["_merge"] == "left_only"].drop(columns="_merge")], ignore_index=True)
    for k in table.index[table["column"] == MEAN_DIFFERENCE]:
        cells = table[(table["table"] == table.loc[k, "table"]) & (table.index != k)]
        table.loc[k, "ours"] = (cells["ours"] - cells["published"]).abs().mean()
    judged = table["published"].notna() & table["ours"].notna() & table["tolerance"].notna()
    inside = (table["ours"] - table["published"]).abs() <= table["tolerance"]
    table["within"] = np.where(judged, np.where(inside, "yes", "no"), "")
    table["paper"] = run.experiment.paper
    table["note"] = table["note"].fillna("")
    places = pd.factorize(table["table"])[0]
    return table[COLUMNS].iloc[np.argsort(places, kind="stable")].reset_index(drop=True)


def side_by_side(comparison: pd.DataFrame, table: str) -> pd.DataFrame:
    """Return one table of `compare` in the layout of the paper, each column split into `published` and `ours`.

    Columns without values are omitted. Raises ValueError for an unknown table.
    """
    cells = comparison[comparison["table"] == table]
    if cells.empty:
        names = ", ".join(dict.fromkeys(comparison["table"]))
        raise ValueError(f"{table!r} is not a table of this experiment; its tables are {names}")
    wide = cells.pivot_table(["published", "ours"], "row", "column", aggfunc="first", sort=False).swaplevel(axis=1)
    columns = pd.MultiIndex.from_product([dict.fromkeys(cells["column"]), ["published", "ours"]])
    return wide.reindex(columns=columns, index=pd.Index(cells["row"].unique(), name="row")).dropna(axis=1, how="all")


def find_experiments(directory: Path, name: str) -> list[Path]:
    """Find the folder of the experiment `name`, or of `all`, in `directory`. Raises InputError if there is none."""
    known = sorted(path.parent for path in directory.glob(f"*/{FILE}"))
    if not known:
        raise InputError(
            f"{directory} contains no experiments (folders with {FILE}); change to the folder that has experiments/, "
            "name it with --experiments, or write those of the papers there first (jaxphoto example experiments)"
        )
    chosen = known if name == "all" else [path for path in known if path.name == name]
    if not chosen:
        names = ", ".join(path.name for path in known)
        raise InputError(f"unknown experiment {name} in {directory}; choose {names} or all")
    return chosen


def load_experiment(folder: Path) -> Experiment:
    """Import EXPERIMENT from experiment.py in `folder`. Raises InputError if it is not defined."""
    path = folder / FILE
    spec = importlib.util.spec_from_file_location(f"jaxphoto_experiment_{folder.name}", path)
    if spec is None or spec.loader is None or not path.is_file():
        raise InputError(f"file not found: {path}; an experiment is a folder with {FILE}")
    module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except Exception as error:
        raise InputError(f"{path} cannot be run ({type(error).__name__}: {error}); correct it") from error
    experiment = getattr(module, "EXPERIMENT", None)
    if not isinstance(experiment, Experiment):
        raise InputError(f"{path} declares no EXPERIMENT; end it with EXPERIMENT = Experiment(...)")
    return experiment
