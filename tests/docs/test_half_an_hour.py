"""A stranger's half hour: every command of docs/half_an_hour.md, in a folder of its own, ends as the page says."""

import re
from pathlib import Path

import pandas as pd
import pytest

from tests.commands import run_script

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_every_command_of_the_page_works(tmp_path):
    page = (ROOT / "docs" / "half_an_hour.md").read_text(encoding="utf-8")
    script = "\n".join(re.findall(r"```sh\n(.*?)```", page, re.DOTALL))
    run_script(script, tmp_path)
    assert list((tmp_path / "what_if").glob("*.csv"))
    for folder in ("results", "results_of_project"):
        assert (tmp_path / folder / "report.html").stat().st_size > 10_000
    both = [pd.read_csv(tmp_path / name / "interior.csv") for name in ("results", "results_of_project")]
    c, sigma = (both[0].set_index("parameter").loc["c_mm", key] for key in ("value", "sigma"))
    assert abs(c - 34.25) < 4 * sigma
    # A pixel of the export has no size: one is a micrometre. Without stations c is known a hundred times worse.
    of_project, its_sigma = (both[1].set_index("parameter").loc["c_mm", key] * 8 for key in ("value", "sigma"))
    assert abs(of_project - c) < 4 * its_sigma and 50 * sigma < its_sigma < 1.0
