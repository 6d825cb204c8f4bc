"""A part of a flight as it is reported: its tables, what is to be said of it, its photographs."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import pandas as pd

from jaxphoto.procedures.flight import FlightPart
from jaxphoto.report.control import control_findings
from jaxphoto.report.findings import Finding, Level, Verdict
from jaxphoto.report.lens import lens_findings
from jaxphoto.report.orientation import ALIKE
from jaxphoto.report.tables import Tables
from jaxphoto.report.verdict import verdict_of
from jaxphoto.report.weights import component_findings
from jaxphoto.statistics.block_geometry import Coverage, coverage


class PartReport(NamedTuple):
    """A part, its tables and what is to be said of it."""

    part: FlightPart
    tables: Tables
    verdict: Verdict
    images: pd.DataFrame
    """image, n_image_points, rms_px, dX_m to dZ_m (recorded minus adjusted position), position (used, left out,
    none)."""
    coverage: Coverage | None
    """What the photographs show of the ground; None where the block has no metres."""

    @property
    def unit(self) -> str:
        """Of coordinates: metres, or the block's own."""
        return "units" if self.coverage is None else "m"

    @property
    def sigma_factor(self) -> float:
        """By what standard deviations of the camera are too small; 1 where neighbouring rays hardly err alike."""
        alike = self.part.oriented.report.alike
        return alike if alike > ALIKE else 1.0


def report_of(part: FlightPart) -> PartReport:
    """Judge a part: what its adjustment says, its weights, its positions, and how far its rays are independent."""
    tables = Tables(part.adjusted)
    found = [*verdict_of(tables).findings, *(component_findings(part.components) if part.components else [])]
    judged = Verdict.of([*found, *lens_findings(tables), *_findings(part)])
    metric = part.placed or part.controlled
    return PartReport(part, tables, judged, _images(part), coverage(part.adjusted) if metric else None)


def _findings(part: FlightPart) -> Iterator[Finding]:
    report = part.oriented.report
    if not report.converged:
        yield Finding(Level.ALARM, "the orientation of the photographs did not settle: see how it was oriented")
    if part.why_still:
        yield Finding(Level.WARNING, part.why_still)
    if part.no_control:
        yield Finding(Level.ALARM, f"the control is not used: {part.no_control}")
    if part.controlled:
        yield from control_findings(part.controlled)
    if part.why_not and not part.controlled:
        frame = (
            "lies where its positions bring it, but is not held by them"
            if part.placed
            else "has a frame and a scale of its own"
        )
        yield Finding(Level.WARNING, f"the block {frame}: {part.why_not}")
    yield from (Finding(Level.WARNING, sentence) for sentence in (part.placed.steps if part.placed else ()))
    if part.placed and not part.placed.used.all():
        n = int((~part.placed.used).sum())
        yield Finding(Level.WARNING, f"{n} of {len(part.placed.used)} recorded positions contradict the others")
    if report.alike > ALIKE:
        text = (
            f"neighbouring rays err alike: multiply the standard deviations of the camera by {report.alike:.2g}; "
            "jaxphoto halves on the block tells it better"
        )
        yield Finding(Level.WARNING, text)


def _images(part: FlightPart) -> pd.DataFrame:
    a = part.adjusted
    block, n = a.block, len(a.block.images)
    pixel = np.array([block.sensors[c].pixel_mm for c in block.image_camera])
    v = np.asarray(a.residuals.image) * np.asarray(a.values.sigma_xy)
    count = np.bincount(a.structure.image, minlength=n)
    square = np.bincount(a.structure.image, (v**2).sum(axis=0), minlength=n)
    off, position = np.full((n, 3), np.nan), np.full(n, "none", object)
    if part.placed:
        at = [block.images.index(name) for name in part.placed.images]
        start = np.asarray(part.placed.block.start.unknowns.exterior.position)[at]
        off[at] = part.placed.offsets_m + start - np.asarray(a.unknowns.exterior.position)[at]
        position[at] = np.where(part.placed.used, "used", "left out")
    rms = np.sqrt(square / np.maximum(2 * count, 1)) / pixel
    columns = {"image": block.images, "n_image_points": count, "rms_px": rms}
    columns |= {f"d{axis}_m": off[:, k] for k, axis in enumerate("XYZ")}
    return pd.DataFrame(columns | {"position": position})
