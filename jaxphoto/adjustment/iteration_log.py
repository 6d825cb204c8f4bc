"""Iteration log for the logger `jaxphoto.adjustment` (level INFO)."""

import logging
from collections.abc import Iterator

from jaxphoto.adjustment.result import Adjustment

LOGGER = logging.getLogger("jaxphoto.adjustment")


def log_iterations(adjusted: Adjustment) -> None:
    """Log the sizes of the adjustment, and one line per step."""
    if LOGGER.isEnabledFor(logging.INFO):
        images, points = len(adjusted.block.images), len(adjusted.block.points)
        LOGGER.info("adjusted %d images, %d points: %s", images, points, adjusted.outcome.value)
        for line in step_lines(adjusted):
            LOGGER.info(line)


def step_lines(adjusted: Adjustment) -> Iterator[str]:
    """Return one line per step: sigma0 before the step and step length in standard deviations; the last line is the
    outcome.
    """
    history, redundancy = adjusted.history, max(adjusted.redundancy, 1)
    if history is None:
        return
    for k, (before, length, damping, accepted, bent) in enumerate(zip(*history, strict=True), 1):
        along = f", {bent:.2g} of it along a curve" if bent > 0 else ""
        refused = "" if accepted > 0 else ", refused"
        moved = f"moves {length:.2g} sigmas, damping {damping:.1g}{along}{refused}"
        yield f"step {k}: sigma naught {(before / redundancy) ** 0.5:.6g}, {moved}"
    if len(history.length) == int(adjusted.steps):
        yield f"end: sigma naught {(float(adjusted.sum_of_squares) / redundancy) ** 0.5:.6g}"
