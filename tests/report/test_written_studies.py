"""Every study writes its tables, its figure, a page with that figure, and a summary."""

import json

import numpy as np
import pytest

from jaxphoto.camera import Brown, InteriorOrientation, parameter_names
from jaxphoto.report.boresight import boresight_parts
from jaxphoto.report.lidar import heights_page
from jaxphoto.report.model_choice import write_model_choice
from jaxphoto.report.page import CommandRecord, page
from jaxphoto.report.sensitivity import SensitivityTables, write_sensitivity
from jaxphoto.report.stability import Compared, write_change, write_halves, write_stability
from jaxphoto.stability import change, image_grid
from tests.blocks import adjusted
from tests.report.studies import GOPRO, boresight_steps, halves_found, lidar_control_of, model_choice_of, ray_offsets

MADE = CommandRecord("jaxphoto study")
ONE, TWO = (InteriorOrientation(c, 0.0, 0.0, Brown()) for c in (2.69, 2.70))
SETS = Compared("A", ONE, True, GOPRO), Compared("B", TWO, False, GOPRO)


def changed():
    covariance = np.diag([1e-6] * 3 + [1e-12] * (len(parameter_names(ONE)) - 3))
    return change(ONE, TWO, image_grid(GOPRO), (covariance, covariance))


STUDIES = {
    "change": (lambda out: write_change(changed(), SETS, GOPRO, out, MADE), {"parameters.csv", "cells.csv"}),
    "offsets": (
        lambda out: write_stability({"rot": ray_offsets()}, SETS, GOPRO, 1e-3, "rot", out, MADE),
        {"stability.csv", "offsets.csv"},
    ),
    "halves": (lambda out: write_halves(halves_found(), out, lambda folder: None, MADE), {"cells.csv", "cuts.csv"}),
    "models": (
        lambda out: write_model_choice(model_choice_of(), adjusted("cross").block, out, {}, MADE),
        {"models.csv", "parameters.csv"},
    ),
    "sensitivity": (
        lambda out: write_sensitivity(SensitivityTables(adjusted("cross"), "block"), out, {}, MADE),
        {"sensitivity.csv", "variance_shares.csv", "external_reliability.csv"},
    ),
}


@pytest.mark.parametrize("name", STUDIES)
def test_a_study_is_written(name, tmp_path):
    write, tables = STUDIES[name]
    write(tmp_path / "out")
    names = {path.name for path in (tmp_path / "out").iterdir() if not path.name.startswith(".")}
    assert names == {*tables, "report.html", "summary.json"}
    text = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "<svg" in text and "<td>jaxphoto study</td>" in text and 'class="verdict' in text
    assert json.loads((tmp_path / "out" / "summary.json").read_text())["versions"]


def test_pages_of_boresight_and_of_cloud_heights():
    text = page("Boresight", boresight_parts(boresight_steps()))
    assert text.count("<svg") == 2 and 'href="step_4/report.html"' in text
    control = lidar_control_of()
    assert heights_page(control, control.block.start.unknowns, MADE).count("<svg") == 2
