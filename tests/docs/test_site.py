"""The documentation is a site without a broken link, and its drawings show what the functions do."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import nbformat
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]


def drawings():
    spec = importlib.util.spec_from_file_location("drawings", ROOT / "docs" / "site" / "drawings.py")
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
    module = drawings()
    roll, pitch, yaw = arrows(module.body_angles())
    assert roll["right"][1] < 0 and pitch["forward"][1] > 0 and yaw["forward"][0] > 0
    omega, phi, kappa = arrows(module.camera_angles())
    # Seen from the end of its axis, omega and kappa are counter-clockwise; phi is drawn from behind its axis.
    assert omega["y"][1] > 0 and kappa["x"][1] > 0 and phi["z"][0] > 0
    by_x, by_y, by_z = arrows(module.boresight())
    assert by_x["z"][0] > 0 and by_y["x"][1] > 0 and by_z["x"][1] < 0


def test_drawings_are_those_of_the_pages():
    page = (ROOT / "docs" / "conventions.md").read_text(encoding="utf-8")
    for name in ("frames", "camera_angles", "body_angles", "image_coordinates", "boresight"):
        assert (ROOT / "docs" / "images" / f"{name}.svg").is_file() and f"(images/{name}.svg)" in page


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
    assert "jaxphoto.procedures.adjust.adjust" in (tmp_path / "site" / "reference" / "procedures.html").read_text()


def test_functions_of_the_papers_are_there():
    page = (ROOT / "docs" / "papers.md").read_text(encoding="utf-8")
    names = re.findall(r"`jaxphoto\.([\w.]+)`", page)
    assert len(names) > 15
    for name in names:
        *rooms, last = name.split(".")
        # A room is imported when it is asked for, and a name of the top from its own room.
        room = importlib.import_module(".".join(["jaxphoto", *rooms]))
        assert hasattr(room, last), name


def test_the_gallery_has_every_notebook_with_a_picture():
    page = (ROOT / "docs" / "gallery.md").read_text(encoding="utf-8")
    shown = re.findall(r"## \[(.+)\]\(\.\./notebooks/(.+)\)", page)
    notebooks = sorted((ROOT / "notebooks").glob("*.ipynb"))
    assert [name for _, name in shown] == [path.name for path in notebooks]
    for (title, _), path in zip(shown, notebooks, strict=True):
        assert f"# {title}\n" in nbformat.read(path, as_version=4).cells[0].source + "\n"
    pictures = re.findall(r"!\[.+\]\((images/gallery/.+)\)", page)
    assert len(pictures) == len(notebooks)
    # Kept in the repository: small.
    assert sum((ROOT / "docs" / picture).stat().st_size for picture in pictures) < 1e6
