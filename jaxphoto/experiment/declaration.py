"""What an experiment is: simulated blocks, variants of them, and the tables asked of these. Declarations only."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from jaxphoto.block import Block
from jaxphoto.report import Tables
from jaxphoto.simulation import Simulation


@dataclasses.dataclass(frozen=True)
class Results(Mapping[str, Tables]):
    """The adjusted variants of one layout, by name; `simulations` are the blocks before, with their truth.

    The truth is that of the whole simulation, whatever `Variant.change` took away.
    """

    adjusted: Mapping[str, Tables]
    simulations: Mapping[str, Simulation]

    def __getitem__(self, variant: str) -> Tables:
        return self.adjusted[variant]

    def __iter__(self) -> Iterator[str]:
        return iter(self.adjusted)

    def __len__(self) -> int:
        return len(self.adjusted)


Cells = dict[tuple[str, str], float]
"""The cells of one table, by row and column."""
Measure = Callable[[Results], Cells]


def as_simulated(block: Block) -> Block:
    """The block as the recipe makes it."""
    return block


@dataclasses.dataclass(frozen=True)
class Variant:
    """One adjustment: `change` of the block, made from the recipe in which `recipe` replaces what it names.

    `recipe` is nested like the TOML file: `{"cameras": {"kodak": {"truth": {"c_mm": 35.5}}}}`.
    """

    change: Callable[[Block], Block] = as_simulated
    recipe: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    file: str = "recipe.toml"
    """The recipe, beside experiment.py."""


@dataclasses.dataclass(frozen=True)
class Experiment:
    """Variants of simulated blocks and the tables printed of them.

    `layouts` blocks are drawn (seeds 0, 1, ...), every variant of each is adjusted, and every table's cells are the
    means over them. `published.csv` beside experiment.py holds what a paper prints, if there is one.
    """

    title: str
    variants: Mapping[str, Variant]
    tables: Mapping[str, Measure]
    layouts: int = 10
    paper: str = ""
