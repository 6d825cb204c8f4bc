"""Running an experiment: draw layouts, adjust every variant of each, average what the tables ask for."""

import dataclasses
from collections.abc import Callable, Mapping
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from jaxphoto.adjustment import Sizes, common_sizes
from jaxphoto.block import Block
from jaxphoto.errors import InputError, JaxphotoError
from jaxphoto.experiment.declaration import Experiment, Results, Variant
from jaxphoto.io.recipe import recipe_from
from jaxphoto.io.toml import read_toml
from jaxphoto.procedures import adjust
from jaxphoto.report import Tables
from jaxphoto.simulation import Recipe, Simulation, simulate

Progress = Callable[[str], None]


@dataclasses.dataclass(frozen=True)
class Run:
    """What an experiment gave: the cells of every layout, the first layout's adjustments, and what went wrong.

    `cells` has the columns table, row, column, layout, value.
    """

    experiment: Experiment
    cells: pd.DataFrame
    first: Mapping[str, Tables]
    failures: tuple[str, ...]


def run_experiment(
    experiment: Experiment, folder: Path, layouts: int | None = None, progress: Progress = lambda _: None
) -> Run:
    """Run `experiment`, whose recipes lie in `folder`. `progress` is told of every step.

    A layout in which a variant cannot be made or adjusted is left out and told of in `failures`. Raises InputError
    where no layout is left, and for recipes that cannot be read.
    """
    recipes = {name: _recipe(variant, folder) for name, variant in experiment.variants.items()}
    failures: list[str] = []
    simulations: dict[int, dict[str, Simulation]] = {}
    wanted, made = layouts or experiment.layouts, count(1)
    for layout in range(wanted):
        progress(f"simulating layout {layout + 1} of {wanted}")
        try:
            simulations[layout] = _simulated(experiment, recipes, layout)
        except (JaxphotoError, ValueError) as error:
            failures.append(f"layout {layout}: {error}")
    sizes = _sizes([{name: s.block for name, s in variants.items()} for variants in simulations.values()])
    rows: list[tuple] = []
    first: dict[str, Tables] = {}
    for layout, variants in simulations.items():
        adjusted = {}
        try:
            for name, simulation in variants.items():
                progress(f"adjusting: block {next(made)} of {len(simulations) * len(variants)}")
                adjusted[name] = _adjusted(simulation.block, sizes[name])
        except JaxphotoError as error:
            failures.append(f"layout {layout}, {name}: {error}")
            continue
        first = first or adjusted
        rows += [
            (table, row, column, layout, value)
            for table, measure in experiment.tables.items()
            for (row, column), value in measure(Results(adjusted, variants)).items()
        ]
    if not first:
        raise InputError(f"{folder}: no layout could be adjusted; the first says: {failures[0]}")
    cells = pd.DataFrame(rows, columns=["table", "row", "column", "layout", "value"])
    return Run(experiment, cells, first, tuple(failures))


def simulated(experiment: Experiment, folder: Path, variant: str, layout: int = 0) -> Simulation:
    """The block of one variant, before `Variant.change`, with its truth."""
    return simulate(_recipe(experiment.variants[variant], folder), layout)


def _simulated(experiment: Experiment, recipes: Mapping[str, Recipe], layout: int) -> dict[str, Simulation]:
    """Every variant with its block; variants of one recipe are changes of one and the same simulation."""
    made: dict[tuple[str, str], Simulation] = {}
    variants = {}
    for name, variant in experiment.variants.items():
        key = (variant.file, repr(variant.recipe))
        if key not in made:
            made[key] = simulate(recipes[name], layout)
        variants[name] = dataclasses.replace(made[key], block=variant.change(made[key].block))
    return variants


def _sizes(layouts: list[dict[str, Block]]) -> dict[str, Sizes]:
    """By variant, sizes for all layouts and all variants of as many images: they share what is compiled."""
    of_images: dict[int, list[Block]] = {}
    for block in (b for variants in layouts for b in variants.values()):
        of_images.setdefault(len(block.images), []).append(block)
    sizes = {n: common_sizes(blocks) for n, blocks in of_images.items()}
    return {name: sizes[len(block.images)] for name, block in layouts[0].items()} if layouts else {}


def _adjusted(block: Block, sizes: Sizes) -> Tables:
    adjusted = adjust(block, sizes=sizes)
    if not bool(adjusted.converged):
        raise InputError(adjusted.outcome.value)
    return Tables(adjusted)


def _recipe(variant: Variant, folder: Path) -> Recipe:
    path = folder / variant.file
    if not path.is_file():
        raise InputError(f"there is no recipe {path}; add it, or correct the variant's file")
    values = read_toml(path)
    return recipe_from(_merged(values, variant.recipe), f"{folder.name}/{variant.file}")


def _merged(values: Any, changes: Any) -> Any:
    """Nested tables with `changes` in place of what they name."""
    if not isinstance(values, Mapping) or not isinstance(changes, Mapping):
        return changes
    return {**values, **{key: _merged(values.get(key, {}), change) for key, change in changes.items()}}


def summary(cells: pd.DataFrame) -> pd.DataFrame:
    """Mean and standard deviation of every cell over the layouts: table, row, column, ours, spread, n_layouts."""
    groups = cells.groupby(["table", "row", "column"], sort=False)["value"]
    # About the first layout: what is the same in all comes out as it is, and without any spread.
    table = groups.agg(
        ours=lambda v: v.iloc[0] + np.mean(v - v.iloc[0]),
        spread=lambda v: np.std(v - v.iloc[0], ddof=1) if len(v) > 1 else np.nan,
        n_layouts="size",
    )
    return table.reset_index()
