"""The main job: complete the start values of a block and adjust it."""

from jaxphoto.adjustment import LEAST, MAX_STEPS, Adjustment, Sizes, solve
from jaxphoto.block import Block
from jaxphoto.orientation import approximate
from jaxphoto.orientation.approximate import has_beginning
from jaxphoto.procedures.orientation import orient_block
from jaxphoto.statistics import prepare_statistics
from jaxphoto.unknowns import Unknowns


def adjust(
    block: Block,
    start: Unknowns | None = None,
    priors: Unknowns | None = None,
    *,
    max_steps: int = MAX_STEPS,
    sizes: Sizes = LEAST,
) -> Adjustment:
    """Self-calibrating bundle adjustment of `block`.

    `start` gives every unknown an approximate value; where it is None, those of the block are completed by resection
    and intersection, and where no image is known or sees four known points, found from image points alone
    (docs/orient.md). `priors` says what is FREE, FIXED or Weighted; where it is None, what the block says.

    What is compiled for a block serves all of similar size; a study of many blocks compiles once if it gives `sizes`
    that all fit into (`common_sizes`).

    With `start` given it is a pure function of the numbers in its arguments: `jax.grad` and `jax.vmap` go through it.

    Raises BlockError where no approximate values can be found, DatumError where position, orientation or scale are left
    open, RankError where the observations cannot tell unknowns apart. A solve that does not converge is no error: see
    `Adjustment.outcome`.
    """
    if start is None:
        start = start_of(block)
    return solve(block, start, block.priors if priors is None else priors, max_steps, sizes)


def adjust_for_tables(block: Block, max_steps: int = MAX_STEPS) -> Adjustment:
    """`adjust`, with what tables and report will want compiled meanwhile."""
    return solve(block, start_of(block), block.priors, max_steps, meanwhile=prepare_statistics)


def start_of(block: Block) -> Unknowns:
    """All approximate values of `block`: `approximate`, after its images are oriented to one another if need be."""
    return approximate(block if has_beginning(block) else orient_block(block))
