"""The documentation is a site without a broken link, and its drawings show what the functions do."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import nbformat
import numpy as np
import pandas as pd
import pytest

from jaxphoto.experiment import read_published

ROOT = Path(__file__).resolve().parents[2]


PAPERS = ROOT / "docs" / "papers.md"


def module_of(name):
    with pytest.MonkeyPatch.context() as patched:
        # As MkDocs loads a hook: modules beside it are found.
        patched.syspath_prepend(str(ROOT / "docs" / "site"))
        return loaded(name)


def loaded(name):
    spec = importlib.util.spec_from_file_location(name, ROOT / "docs" / "site" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def arrows(figure):
    """Of every panel, where named solid arrows end."""
    return [
        {a.get_text(): np.array(a.xy) for a in panel.texts if a.get_text() and a.get_weight() == "bold"}
        for panel in figure.axes
    ]


def test_drawings_turn_as_the_words_of_the_page_say():
    module = module_of("drawings")
    roll, pitch, yaw = arrows(module.body_angles())
    assert roll["right"][1] < 0 and pitch["forward"][1] > 0 and yaw["forward"][0] > 0
    omega, phi, kappa = arrows(module.camera_angles())
    # Seen from the end of its axis, omega and kappa are counter-clockwise; phi is drawn from behind its axis.
    assert omega["y"][1] > 0 and kappa["x"][1] > 0 and phi["z"][0] > 0
    by_x, by_y, by_z = arrows(module.boresight())
    assert by_x["z"][0] > 0 and by_y["x"][1] > 0 and by_z["x"][1] < 0


def test_drawings_are_those_of_the_pages():
    page = (ROOT / "docs" / "conventions.md").read_text(encoding="utf-8")
    drawn = set(re.findall(r"\(images/([\w]+\.svg)\)", page))
    assert len(drawn) == 17 and drawn == {path.name for path in (ROOT / "docs" / "images").glob("*.svg")}


def test_which_of_roll_and_pitch_is_omega_is_what_the_page_says():
    module = module_of("drawings")
    page = (ROOT / "docs" / "conventions.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (\w+) \| (\d+) \| (-?\d+) \| (\w+) ([+-]1) \| (\w+) ([+-]1) \|$", page, re.MULTILINE)
    assert [(name, float(yaw)) for name, yaw, *_ in rows] == list(module.HEADINGS.items())
    for _, yaw, kappa, *turns in rows:
        level = module.attitude_of(0.0, 0.0, float(yaw))
        np.testing.assert_allclose(level, [0, 0, float(kappa)], atol=1e-9)
        for k, (angle, by) in enumerate(zip(turns[::2], turns[1::2], strict=True)):
            tilt = module.attitude_of(*np.eye(2)[k], float(yaw)) - level
            np.testing.assert_allclose(tilt, float(by) * np.array([angle == "omega", angle == "phi", 0]), atol=1e-9)


def test_tables_of_the_papers_are_what_is_kept_and_what_is_printed():
    tables = module_of("paper_tables")
    kept = pd.read_csv(tables.KEPT, dtype={"paper": str, "row": str})
    page = PAPERS.read_text(encoding="utf-8")
    assert tables.with_tables(page) == page
    for paper, cells in kept.groupby("paper"):
        place = page.split(f"<!-- tables {paper} -->")[1].split("<!-- end of tables -->")[0]
        assert f"{(cells['within'] == 'yes').sum()} are within" in place
        key = ["table", "row", "column"]
        printed = read_published(ROOT / "experiments" / paper).set_index(key)["published"].dropna()
        ours = cells.set_index(key)["published"].dropna()
        pd.testing.assert_series_equal(ours.sort_index(), printed.sort_index(), check_exact=False, rtol=1e-5)
    assert set(kept["paper"]) == {"000", "002", "003", "004"}


@pytest.mark.slow
def test_the_site_is_built_without_a_warning(tmp_path):
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path / "site")]
    found = subprocess.run(
        command, cwd=ROOT, env=os.environ | {"NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True, check=False
    )
    assert found.returncode == 0, found.stderr
    pages = {path.relative_to(tmp_path / "site").as_posix() for path in (tmp_path / "site").rglob("*.html")}
    assert {"index.html", "conventions.html", "reference/procedures.html"} <= pages
    assert len([page for page in pages if page.startswith("notebooks/")]) == len(list(ROOT.glob("notebooks/*.ipynb")))
    for page in (tmp_path / "site").rglob("*.html"):
        links = re.findall(r'(?:href|src)="([^":#?]+)["#?]', page.read_text(encoding="utf-8"))
        # The page of what is not found is shown under any address.
        assert page.name == "404.html" or not [k for k in set(links) if not (page.parent / k).exists()], page.name
    # Names on the pages lead to the reference, formulas are MathML.
    paper = (tmp_path / "site" / "papers.html").read_text(encoding="utf-8")
    assert 'href="reference/collinearity.html#jaxphoto.collinearity.project"' in paper
    assert "<math" in paper and "$" not in re.sub(r"<annotation.*?</annotation>", "", paper)
    assert "jaxphoto.procedures.adjust.adjust" in (tmp_path / "site" / "reference" / "procedures.html").read_text()


def test_functions_of_the_papers_are_there():
    names = set(re.findall(r"`jaxphoto\.([\w.]+)`", PAPERS.read_text(encoding="utf-8")))
    assert len(names) > 35
    for name in names:
        *rooms, last = name.split(".")
        # A room is imported when it is asked for, and a name of the top from its own room.
        room = importlib.import_module(".".join(["jaxphoto", *rooms]))
        assert hasattr(room, last), name


def test_notebooks_carry_the_outputs_of_their_code():
    module = module_of("outputs")
    for path in module.NOTEBOOKS:
        notebook = nbformat.read(path, as_version=4)
        assert module.is_current(notebook), f"{path.name} has changed: python docs/site/outputs.py {path.stem}"
        kinds = {kind for cell in notebook.cells for o in cell.get("outputs", ()) for kind in o.get("data", ())}
        assert kinds & {"image/png", "text/html"}, path.name
    assert sum(path.stat().st_size for path in module.NOTEBOOKS) < 4e6


def test_outputs_of_other_code_are_noticed():
    module = module_of("outputs")
    changed = nbformat.read(module.NOTEBOOKS[0], as_version=4)
    next(cell for cell in changed.cells if cell.cell_type == "code").source += "\n1 + 1"
    assert not module.is_current(changed)


def test_links_read_as_the_heading_of_a_page_that_settings_stand_before():
    titles = {page.name: module_of("pages")._title(page) for page in (ROOT / "docs").glob("**/*.md")}
    assert titles["formats.md"] == "Formats" and all(re.match(r"\w", title) for title in titles.values()), titles
