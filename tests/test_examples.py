"""The example block, and what README and docs claim: their Python runs, their links lead somewhere."""

import re
import runpy
import tomllib
from pathlib import Path

import jax
import numpy as np
import pandas as pd
import pytest

import jaxphoto
from jaxphoto.camera.distortion import DISTORTIONS
from jaxphoto.extras.formats import EXPORTS, FORMATS
from jaxphoto.io.block_folder.settings import read_settings
from jaxphoto.io.block_folder.table_layout import LAYOUTS
from jaxphoto.report.results import _TABLES
from jaxphoto_command import app
from tests.marks import slow_but

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "examples"
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *EXAMPLES.glob("*.md")])
# Whole procedures on blocks of their own size, for each of which there are tests.
LONG = (
    "boresight",
    "control",
    "extending",
    "georeferencing",
    "monte_carlo",
    "network_design",
    "notebook",
    "papers",
    "sensitivity",
    "statistics",
    "time_dependent_cameras",
    "trust",
)


@pytest.fixture(scope="module")
def adjusted() -> jaxphoto.Adjustment:
    return jaxphoto.adjust(jaxphoto.read_block(EXAMPLES / "cross_block"))


def test_example_recovers_the_truth(adjusted: jaxphoto.Adjustment) -> None:
    assert adjusted.outcome is jaxphoto.Outcome.CONVERGED
    interior = jaxphoto.Tables(adjusted).interior.dropna()
    truth = pd.read_csv(EXAMPLES / "cross_block_truth.csv")
    assert list(interior["parameter"]) == list(truth["parameter"])
    off = (interior["value"].to_numpy() - truth["value"].to_numpy()) / interior["sigma"].to_numpy()
    assert np.abs(off).max() < 3
    # Five standard deviations of sigma naught of a block of this redundancy.
    assert abs(float(adjusted.sigma0) - 1) < 5 / np.sqrt(2 * adjusted.redundancy)


def test_example_is_what_readme_says(adjusted: jaxphoto.Adjustment) -> None:
    block = adjusted.block
    assert len(block.images) == 31
    assert len(block.points) == 154 + 33
    assert len(set(block.control.who)) == 13
    assert len(set(block.check.who)) == 20
    mean = jaxphoto.Tables(adjusted).correlations["kodak"].mean_abs
    assert mean[3:5, 1:3].min() > 0.2
    assert mean[:, 0].max() < 0.1


def test_example_can_be_made_again(tmp_path: Path) -> None:
    make = runpy.run_path(str(EXAMPLES / "make_cross_block.py"))["main"]
    make(tmp_path / "cross_block")
    for made in sorted(tmp_path.rglob("*.*")):
        kept = EXAMPLES / made.relative_to(tmp_path)
        if made.suffix != ".csv":
            assert made.read_text(encoding="utf-8") == kept.read_text(encoding="utf-8")
            continue
        # One unit of the last digit, where another machine rounds the other way.
        pd.testing.assert_frame_equal(pd.read_csv(made), pd.read_csv(kept), rtol=0, atol=1.1 * _last_digit(kept))
    names = lambda folder: {p.relative_to(folder) for p in folder.rglob("cross_block*/*")}  # noqa: E731
    assert names(tmp_path) == names(EXAMPLES)


def _last_digit(path: Path) -> float:
    """The place value of the last decimal that a CSV gives."""
    decimals = re.findall(r"\.(\d+)(?=[,\n])", path.read_text(encoding="utf-8"))
    return 10.0 ** -max(map(len, decimals)) if "truth" not in path.name else 0.0


def test_picture_can_be_drawn(tmp_path: Path) -> None:
    draw = runpy.run_path(str(EXAMPLES / "make_picture.py"))["main"]
    draw(tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 10_000


def _python(page: Path) -> list[str]:
    return re.findall(r"^```python\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


@pytest.mark.parametrize(
    "page", slow_but(lambda p: p.stem not in LONG, [p for p in PAGES if _python(p)]), ids=lambda p: p.name
)
def test_python_on_pages_runs(page: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # Readme's user has a clone, the other pages' user the files of `jaxphoto example`.
    monkeypatch.chdir(ROOT if page.parent == ROOT else EXAMPLES)
    # Commands and formats that a page registers are removed afterwards.
    monkeypatch.setattr(app, "registered_commands", list(app.registered_commands))
    names: dict[str, object] = {"__name__": page.stem}
    try:
        for number, text in enumerate(_python(page)):
            exec(compile(text, f"{page.name}, block {number + 1}", "exec"), names)
    finally:
        jax.config.update("jax_enable_x64", True)
        for registered in (FORMATS, EXPORTS):
            registered.pop("track", None)


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.name)
def test_links_lead_somewhere(page: Path) -> None:
    links = re.findall(r"\]\(([^)#\s]+)", page.read_text(encoding="utf-8"))
    assert [link for link in links if "://" not in link and not (page.parent / link).exists()] == []


def test_block_folder_page_shows_a_readable_block_toml() -> None:
    text = re.search(r"^```toml\n(.*?)^```", (ROOT / "docs/block_folder.md").read_text(encoding="utf-8"), re.M | re.S)
    assert text is not None
    keys = ["distance_m"]
    assert list(read_settings(tomllib.loads(text[1]), sigma_keys=keys).cameras) == ["kodak"]


def test_block_folder_page_lists_the_columns_of_every_table() -> None:
    lines = (ROOT / "docs/block_folder.md").read_text(encoding="utf-8").splitlines()
    for name, layout in LAYOUTS.items():
        row = next(line for line in lines if line.startswith(f"| `{name}.csv`"))
        assert [column.name for column in layout.columns if column.name not in row] == []


def test_pages_name_every_distortion_and_coefficient() -> None:
    text = (ROOT / "docs/models.md").read_text(encoding="utf-8")
    for name, model in DISTORTIONS.items():
        assert f"`{name}`" in text
        assert [c for c in model.coefficients if not re.search(rf"\b{c}\b", text)] == []


def test_pages_name_every_result_file_and_column(adjusted: jaxphoto.Adjustment) -> None:
    text = (ROOT / "docs/block_folder.md").read_text(encoding="utf-8")
    tables = jaxphoto.Tables(adjusted)
    # exterior.csv is described in short.
    for name in set(_TABLES) - {"exterior"}:
        assert f"| `{name}.csv` | {', '.join(getattr(tables, name).columns)} |" in text
