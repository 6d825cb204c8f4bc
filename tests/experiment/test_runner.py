"""Experiments run as declared, and results are written completely."""

import subprocess
import sys

import numpy as np
import pandas as pd
import pytest
from typer.testing import CliRunner

import jaxphoto
from jaxphoto.errors import InputError
from jaxphoto.experiment import compare, find_experiments, load_experiment, run_experiment, simulated, write_runs
from jaxphoto.variants import vertical_control
from jaxphoto_command import app

RECIPE = """
title = "small"
[cameras.small]
width_px = 4500
height_px = 3000
pixel_mm = 0.008
distortion = "brown"
interior = { c_mm = 34.0 }
truth = { c_mm = 34.25, xp_mm = 0.06 }
unknowns = { c_mm = "free", xp_mm = "free" }
[flight]
height_m = 1000.0
forward_overlap_percent = 60.0
strips = [{ name = "A", heading_deg = 90.0, images = 4 }, { name = "B", heading_deg = 0.0, images = 4 }]
[terrain]
kind = "rolling"
[points]
ties = 40
[[targets]]
role = "control"
count = 6
[[targets]]
role = "check"
prefix = "C"
count = 4
[sigmas]
image_mm = 0.004
control_m = 0.03
station_m = 0.10
"""
DECLARED = """
from jaxphoto.experiment import Experiment, Variant, check_points, iops, tie_point_differences
from jaxphoto.variants import vertical_control

EXPERIMENT = Experiment(
    title="small",
    paper="own",
    variants={
        "full": Variant(),
        "vertical": Variant(vertical_control),
        "longer": Variant(recipe={"cameras": {"small": {"truth": {"c_mm": 34.75}}}}),
    },
    tables={
        "iops": iops({"1": "full", "2": "longer"}),
        "check": check_points({"full": "full"}),
        "ties": tie_point_differences([("full", "vertical")]),
    },
    layouts=5,
)
"""
PUBLISHED = """table,row,column,published,unit,tolerance,note
iops,1,c_mm,34.25,mm,0.1,
iops,1,xp_mm,9.0,mm,0.1,far off
iops,1,yp_mm,0.0,mm,,
iops,all,mean_abs_difference,0,,1e9,
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    place = tmp_path_factory.mktemp("experiments") / "small"
    place.mkdir()
    for name, text in (("recipe.toml", RECIPE), ("experiment.py", DECLARED), ("published.csv", PUBLISHED)):
        (place / name).write_text(text)
    return place


@pytest.fixture(scope="module")
def run(folder):
    return run_experiment(load_experiment(folder), folder, layouts=2)


def test_cells_are_those_of_each_layout_adjusted_by_itself(folder, run):
    experiment = load_experiment(folder)
    for layout in (0, 1):
        full = simulated(experiment, folder, "full", layout).block
        c = float(jaxphoto.adjust(full).unknowns.interior["small"].c)
        points, differences = jaxphoto.point_differences(jaxphoto.adjust(full), jaxphoto.adjust(vertical_control(full)))
        ties = [k for k, point in enumerate(points) if point[0] not in "TC"]
        cells = run.cells[run.cells["layout"] == layout].set_index(["table", "row", "column"])["value"]
        assert cells["iops", "1", "c_mm"] == pytest.approx(c, abs=1e-9)
        assert cells["ties", "full-vertical", "mean_dX_m"] == pytest.approx(differences[ties, 0].mean(), abs=1e-7)
        assert cells["check", "full", "n_check_points"] == 4
    assert not run.failures
    assert set(run.first) == {"full", "vertical", "longer"}


@pytest.mark.slow
def test_workers_give_the_same_cells(folder, run, tmp_path):
    pytest.importorskip("distributed", reason="distributed is not installed (extra cluster)")
    # Functions wrapped by the type checks of this process cannot be sent to another.
    command = "import sys; from jaxphoto_command import main; sys.exit(main())"
    options = ["--experiments", folder.parent, "--layouts", "2", "--workers", "1", "--out", tmp_path / "runs"]
    subprocess.run([sys.executable, "-c", command, "experiment", "small", *map(str, options)], check=True)
    again = pd.read_csv(tmp_path / "runs" / "cells.csv", dtype={"row": str})
    pd.testing.assert_frame_equal(again[run.cells.columns], run.cells, rtol=1e-9, check_dtype=False)


def test_a_variant_replaces_what_it_names_in_the_recipe_and_nothing_else(run):
    c = run.cells[(run.cells["table"] == "iops") & (run.cells["column"] == "c_mm")].groupby("row")["value"].mean()
    assert c["1"] == pytest.approx(34.25, abs=0.1)
    assert c["2"] == pytest.approx(34.75, abs=0.1)
    x = run.cells[(run.cells["table"] == "iops") & (run.cells["column"] == "xp_mm")].groupby("row")["value"].mean()
    assert x["2"] == pytest.approx(0.06, abs=0.03)


def test_comparison_holds_every_printed_and_every_own_cell_with_its_judgement(folder, run):
    table = compare(run, folder)
    expected = ["paper", "table", "row", "column", "published", "ours", "unit", "tolerance", "within", "note"]
    assert table.columns.tolist()[:10] == expected
    cell = table.set_index(["table", "row", "column"])
    values = run.cells.set_index(["table", "row", "column"])["value"].sort_index()
    ours = values["iops", "1", "c_mm"].to_numpy()
    assert cell.loc[("iops", "1", "c_mm"), "ours"] == pytest.approx(ours.mean(), abs=1e-12)
    assert cell.loc[("iops", "1", "c_mm"), "spread"] == pytest.approx(ours.std(ddof=1), rel=1e-9)
    assert cell.loc[("iops", "1", "c_mm"), "within"] == "yes"
    assert cell.loc[("iops", "1", "xp_mm"), ["within", "note"]].tolist() == ["no", "far off"]
    assert cell.loc[("iops", "1", "yp_mm"), "within"] == ""  # printed, but fixed in ours
    assert np.isnan(cell.loc[("iops", "1", "yp_mm"), "ours"])
    assert np.isnan(cell.loc[("iops", "2", "c_mm"), "published"])
    means = [abs(ours.mean() - 34.25), abs(values["iops", "1", "xp_mm"].mean() - 9.0)]
    assert cell.loc[("iops", "all", "mean_abs_difference"), "ours"] == pytest.approx(np.mean(means), rel=1e-9)
    assert (table["paper"] == "own").all()
    assert not table.duplicated(["table", "row", "column"]).any()
    assert len(table) == len(values.groupby(level=[0, 1, 2]).size()) + 2


def test_a_run_is_written_whole_and_read_back(folder, run, tmp_path):
    out = tmp_path / "out"
    write_runs({folder: run}, out)
    columns = ["ours", "published"]
    table = pd.read_csv(out / "tables.csv", dtype={"row": str}, keep_default_na=False, na_values=[""])
    pd.testing.assert_frame_equal(table[columns], compare(run, folder)[columns])
    assert len(pd.read_csv(out / "cells.csv")) == len(run.cells)
    page = (out / "report.html").read_text()
    assert "far off" in page and "34.25" in page and "<svg" in page
    write_runs({folder: run}, out)  # an earlier run is replaced
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("x")
    with pytest.raises(InputError, match="was not written by jaxphoto"):
        write_runs({folder: run}, tmp_path / "mine")
    assert (tmp_path / "mine" / "thesis.tex").read_text() == "x"


def test_several_experiments_share_the_tables_and_have_a_page_each(folder, run, tmp_path):
    other = tmp_path / "other"
    other.mkdir()
    write_runs({folder: run, other: run}, tmp_path / "out")
    table, cells = (pd.read_csv(tmp_path / "out" / name) for name in ("tables.csv", "cells.csv"))
    assert len(table) == len(compare(run, folder)) + len(compare(run, other))
    assert cells["experiment"].value_counts().to_dict() == {"small": len(run.cells), "other": len(run.cells)}
    index = (tmp_path / "out" / "report.html").read_text()
    for name in ("small", "other"):
        assert f'href="{name}.html"' in index
        assert "<svg" in (tmp_path / "out" / f"{name}.html").read_text()


def test_impossible_layouts_are_skipped_with_a_message(folder, tmp_path):
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "recipe.toml").write_text(RECIPE)
    text = DECLARED.replace("Variant(vertical_control)", "Variant(sometimes)").replace(
        "EXPERIMENT =",
        "import numpy as np\nfrom jaxphoto.errors import BlockError\n\n"
        "def sometimes(block):\n"
        f"    if np.asarray(block.image_points.xy)[0, 0] == {first_coordinate(folder)!r}:\n"
        "        raise BlockError('not this one')\n"
        "    return vertical_control(block)\n\nEXPERIMENT =",
    )
    (broken / "experiment.py").write_text(text)
    run = run_experiment(load_experiment(broken), broken, layouts=2)
    assert len(run.failures) == 1 and "layout 1" in run.failures[0] and "not this one" in run.failures[0]
    assert run.cells["layout"].unique().tolist() == [0]
    write_runs({broken: run}, tmp_path / "o")
    assert "skipped: layout 1" in (tmp_path / "o" / "report.html").read_text()


def first_coordinate(folder) -> float:
    block = simulated(load_experiment(folder), folder, "vertical", 1).block
    return float(np.asarray(block.image_points.xy)[0, 0])


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({}, "contains no experiments"),
        ({"small/experiment.py": "EXPERIMENT = 3"}, "declares no EXPERIMENT"),
        ({"small/experiment.py": "import nothing_of_the_kind"}, "cannot be run .ModuleNotFoundError"),
        ({"small/experiment.py": DECLARED}, "recipe not found"),
        ({"small/experiment.py": DECLARED, "small/recipe.toml": RECIPE.replace("ties", "tis")}, "tis: unknown key"),
        ({"other/experiment.py": DECLARED}, "unknown experiment small.*choose other or all"),
    ],
)
def test_what_is_no_experiment_is_refused(files, message, tmp_path):
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=message):
        for found in find_experiments(tmp_path, "small"):
            run_experiment(load_experiment(found), found)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("table,row,column\n", "the column published is missing"),
        (PUBLISHED + "iops,1,c_mm,34.25,mm,0.1,\n", "c_mm is printed twice"),
    ],
)
def test_published_tables_that_cannot_be_are_refused(text, message, run, tmp_path):
    (tmp_path / "published.csv").write_text(text)
    with pytest.raises(InputError, match=message):
        compare(run, tmp_path)


def test_the_command_runs_a_users_own_experiments(folder, tmp_path):
    arguments = [
        "experiment", "all", "--experiments", str(folder.parent), "--layouts", "1", "--out", str(tmp_path / "out"),
    ]  # fmt: skip
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    table = pd.read_csv(tmp_path / "out" / "tables.csv")
    assert table["n_layouts"].max() == 1
    assert str(tmp_path / "out") in done.output.replace("\n", "")
