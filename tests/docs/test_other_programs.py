"""Projects of other programs: the commands of docs/formats.md, and the camera that each results in."""

import re
from pathlib import Path

import pandas as pd
import pytest

from tests.commands import run_script

PAGE = Path(__file__).resolve().parents[2] / "docs" / "formats.md"


def scripts():
    """Return the shell lines of each section, after those that write the example."""
    parts = re.split(r"^#{2,3} (.+)$", PAGE.read_text(encoding="utf-8"), flags=re.MULTILINE)
    return {
        name: "\n".join(["jaxphoto example cross_block", *re.findall(r"```sh\n(.*?)```", text, re.DOTALL)])
        for name, text in zip(parts[1::2], parts[2::2], strict=True)
    }


def estimated(results):
    return pd.read_csv(results / "interior.csv").set_index("parameter")[["value", "sigma"]]


@pytest.mark.slow
@pytest.mark.parametrize(("program", "px_mm"), [("Metashape", 0.008), ("COLMAP", 0.001), ("Pix4D", 0.008)])
def test_the_exported_example_results_in_its_camera(program, px_mm, tmp_path):
    run_script(scripts()[program], tmp_path)
    found = estimated(tmp_path / f"results_{program.lower()}")
    c, sigma = found.loc["c_mm"] * 0.008 / px_mm
    # The true value; a free network determines c to some 1.2 %.
    assert abs(c - 34.25) < 4 * sigma and 0.2 < sigma < 0.8
    assert (tmp_path / f"results_{program.lower()}" / "report.html").stat().st_size > 10_000


@pytest.mark.slow
def test_a_project_of_dbat_has_the_sigma_naught_of_its_report(data_dir, tmp_path, monkeypatch):
    monkeypatch.setenv("JAXPHOTO_DATA", str(data_dir))
    run_script(scripts()["DBAT"], tmp_path)
    summary = pd.read_json(tmp_path / "results_dbat" / "summary.json", typ="series")
    assert f"{summary['sigma0']:.4f}" == "1.1786" and summary["redundancy"] == 1261
    page = PAGE.read_text(encoding="utf-8")
    assert "Sigma naught is 1.1786 with a redundancy of 1261" in page
