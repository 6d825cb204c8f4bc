"""The report of a small adjusted block in place of a flight."""

import functools

import numpy as np
import pandas as pd

from jaxphoto import covariance
from jaxphoto.adjustment import MINIMAL_SIZES
from jaxphoto.camera.conditions import Conditions
from jaxphoto.initial.matches import MatchedPart
from jaxphoto.procedures.flight import FlightPart
from jaxphoto.procedures.georeference_photographs import GeoreferencedPhotographs
from jaxphoto.procedures.orientation import Oriented
from jaxphoto.procedures.orientation.orient_photographs import GrossErrors, OrientationReport
from jaxphoto.report.findings import Finding, Verdict
from jaxphoto.report.flight import FlightSource, PartReport, report_of
from jaxphoto.statistics import CorrelatedNoise
from jaxphoto.writing import InputFile
from tests.blocks import BROWN, adjusted

# Recorded minus adjusted (m), X, Y, Z of the first images; the last of them is left out.
OFFSETS_M = np.array([[0.1, -0.2, 0.3], [0.3, 0.2, 0.1], [-0.1, 0.3, 0.2], [9.0, 0.0, 0.0]])
VERDICT = Verdict.of(
    [Finding("message", "warning", "one thing to know"), Finding("message", "note", "c of camera one")]
)


@functools.cache
def part_report() -> PartReport:
    """The block "cross" as the only part of a flight, whose first photographs have positions."""
    found = adjusted("cross")
    block, n = found.block, len(found.block.images)
    report = OrientationReport(
        n, 500, 20, block.images, {}, GrossErrors(0, 3, 2, 1, 0, 4), len(block.points), 300, 2,
        True, True, 2.0, 0.5, 1.0, ("c_mm",), (), {"c_mm": 1.5},
    )  # fmt: skip
    placed = GeoreferencedPhotographs(block, block.images[:4], OFFSETS_M, np.array([True] * 3 + [False]), ())
    matched = MatchedPart(
        list(block.images), [np.zeros((k + 5, 2)) for k in range(n)], [], [], np.zeros((0, 3), int), 1.0
    )
    residuals = np.asarray(found.residuals.image).T * np.asarray(block.image_points.sigma)
    # All standard deviations of the camera are 1.5 times those of independent errors.
    stated = covariance(found)
    independent = np.asarray(stated.matrix)[6 * n :, 6 * n :]
    correlated = 1.5**2 * float(found.sigma0) ** 2 * independent
    noise = CorrelatedNoise(
        (), np.zeros(0), found.structure.labels, correlated, correlated, independent, float(found.sigma0)
    )
    part = FlightPart(Oriented(block, residuals, report, MINIMAL_SIZES), matched, placed, "", None, found, noise)
    d = np.full((n, 3), np.nan)
    d[:4] = OFFSETS_M
    images = pd.DataFrame({"image": block.images, "n_image_points": np.bincount(found.structure.image, minlength=n)})
    images = images.assign(rms_px=np.linspace(0.3, 1.2, n), dX_m=d[:, 0], dY_m=d[:, 1], dZ_m=d[:, 2])
    images = images.assign(position=["used"] * 3 + ["left out"] + ["none"] * (n - 4))
    return PartReport(part, report_of(part).tables, VERDICT, images)


def source() -> FlightSource:
    """A photograph and another file as inputs."""
    return FlightSource(
        ("positions are of EXIF",), "c is the focal length of EXIF.", BROWN,
        (Conditions("i0", "i0.jpg", "0" * 64, time="2024-05-01 10:00:00"),),
        (InputFile("i0.jpg", 3, "0" * 64), InputFile("survey.csv", 5, "ab" * 32)),
        {"method": {"command": "fly", "features": 500, "epsg": None}}, "jaxphoto fly photographs",
    )  # fmt: skip
