"""The example of docs/papers.md is read and simulated, and its measures exist."""

import re
from pathlib import Path

import jaxphoto.experiment
from jaxphoto.experiment import load_experiment, read_published, simulated

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "papers.md").read_text(encoding="utf-8")


def listing(start: str) -> str:
    """The one listing of the page that starts so."""
    (found,) = [code for code in re.findall(r"```\w*\n(.*?)```", PAGE, re.DOTALL) if code.startswith(start)]
    return found


def test_the_example_is_an_experiment(tmp_path):
    folder = tmp_path / "stations"
    folder.mkdir()
    (folder / "recipe.toml").write_text(listing("title ="))
    (folder / "experiment.py").write_text(listing("from jaxphoto.experiment import Experiment"))
    (folder / "published.csv").write_text(listing("table,row,column"))
    experiment = load_experiment(folder)
    for name, variant in experiment.variants.items():
        block = variant.change(simulated(experiment, folder, name).block)
        assert bool(len(block.stations.who)) == (name != "no stations")
        assert len(block.images) == 24
    published = read_published(folder)
    assert set(published["table"]) <= set(experiment.tables)
    assert set(published["row"]) <= set(experiment.variants)


def test_every_measure_of_the_page_is_there():
    rows = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \| ", PAGE.split("### Tables")[1].split("\n## ")[0], re.MULTILINE)
    named = {name for row in rows for name in re.findall(r"`(\w+)`", row)}
    assert named <= set(jaxphoto.experiment.__all__)
    assert {"iops", "effects", "check_points"} <= named
