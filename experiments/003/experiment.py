"""Paper 003: the boresight misalignment in four steps, with (A) and without (B) cross strips."""

from functools import partial

from jaxphoto.block import Block
from jaxphoto.experiment import (
    Experiment,
    Variant,
    boresight_correlation,
    misalignment,
    misalignment_agreement,
    principal_point,
)
from jaxphoto.procedures.boresight import step_block
from jaxphoto.variants import strips

EAST_WEST = ("E1", "E2", "E3", "E4")


def step(block: Block, config: str, number: int) -> Block:
    """One of the four steps, over all strips or the east-west ones."""
    return step_block(block if config == "A" else strips(block, EAST_WEST), number)


variants = {f"{c}/{n}": Variant(partial(step, config=c, number=n)) for c in "AB" for n in (1, 2, 3, 4)}


def rows(number: int) -> dict[str, str]:
    """Return the variant of one step by configuration."""
    return {c: f"{c}/{number}" for c in "AB"}


EXPERIMENT = Experiment(
    title="Paper 003: boresight misalignment in four steps, with and without cross strips",
    paper="003",
    variants=variants,
    tables={
        "table1_principal_point": principal_point(rows(1)),
        "table2_misalignment": misalignment(rows(3)),
        "table3_misalignment_no_gcp": misalignment(rows(4)),
        "agreement": misalignment_agreement({f"A-B, step {n}": (f"A/{n}", f"B/{n}") for n in (3, 4)}),
        "cross_strips": boresight_correlation(rows(3)),
    },
    layouts=10,
)
