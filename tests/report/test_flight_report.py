"""The page of a flight has the numbers of its adjustment, in a fixed order."""

import re
from pathlib import Path

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.quiver import Quiver

from jaxphoto.camera import get_parameter
from jaxphoto.camera.conditions import Conditions
from jaxphoto.procedures.control import ControlledBlock
from jaxphoto.procedures.control.marks import Marked
from jaxphoto.report.findings import as_sentence
from jaxphoto.report.flight import (
    axis_cell,
    flight_estimates,
    flight_page,
    flight_summary,
    offset_statistics,
    plot_position_offsets,
    positions_section,
    provenance_section,
)
from jaxphoto.report.results import interior_table
from jaxphoto.report.tables import Tables
from tests.blocks import BROWN
from tests.report.flights import OFFSETS_M, VERDICT, part_report, source


@pytest.fixture(scope="module")
def page():
    """Two parts, the second the same as the first; a photograph lost at each of two stages."""
    parts = [part_report(), part_report()]
    return flight_page(
        parts, {"x9": "nothing like it"}, {"cut.jpg": "cut.jpg: cut off"}, VERDICT, source(), ["r", "r2"]
    )


def test_the_verdict_is_first_then_linked_contents_of_all_sections(page):
    begins = page.index(as_sentence(VERDICT.headline)), page.index("One thing to know."), page.index("<nav>")
    assert sorted(begins) == list(begins) and begins[-1] < page.index("<h2")
    links = re.findall(r'<a href="#([^"]+)">([^<]+)</a>', page)
    assert links == re.findall(r'<h2 id="([^"]+)">([^<]+)</h2>', page) and len(dict(links)) == len(links) > 15


def test_standard_deviations_of_the_camera_contain_the_factor_of_correlated_residuals():
    report = part_report()
    table = flight_estimates(report, BROWN).set_index("parameter")
    interior = Tables(report.part.adjusted).interior.dropna(subset="sigma")
    for one in interior.itertuples():
        row = table.loc[f"interior[{one.camera}].{one.parameter}"]
        assert row["sigma"] == pytest.approx(1.5 * one.sigma) and row["value"] == one.value
        assert row["initial"] == float(get_parameter(BROWN, one.parameter))
    assert len(interior) and len(table) == len(interior) + len(report.tables.georeferencing)


def test_the_documentation_lists_the_sections_of_the_page(page):
    told = re.findall(r'<h2 id="[^"]+">([^<]+)</h2>', page)
    document = (
        (Path(__file__).parents[2] / "docs" / "report.md").read_text(encoding="utf-8").split("## Report of a flight")[1]
    )
    listed = re.findall(r"^\| ([^|]+) \|", document.split("\n\nContents of other reports")[0], re.MULTILINE)[2:]
    assert [t for t in told if t not in ("Part 2", "Files")] == [t for t in listed if t in told]
    # Sections of blocks with control, check points, more than one mount, or variance components.
    optional = {"Mounts and strips", "Control points", "Check points: surveyed minus computed", "Variance components"}
    assert set(listed) - set(told) <= optional


def test_every_figure_has_a_description(page):
    described = re.findall(r'<figure role="img" aria-label="[^"]{9,}"><svg', page)
    assert page.count('<figure role="img"') == len(described) > 12


def test_lost_photographs_and_what_was_computed_how_are_named(page):
    rows = [re.findall(r"<td[^>]*>([^<]*)</td>", row) for row in re.findall(r"<tr>.*?</tr>", page, re.DOTALL)]
    assert ["x9", "nothing like it"] in rows and ["cut.jpg", "cut off"] in rows
    assert ["survey.csv", "5", "ab" * 32] in rows
    # An option that was not given is none.
    assert ["jaxphoto fly photographs"] in rows and ["features 500"] in rows
    n = len(part_report().images)
    assert ["images oriented", *[f"{n} of {2 * n + 2}"] * 2] in rows


def test_initial_and_estimated_camera_are_shown():
    report = part_report()
    rows = interior_table(report.tables, BROWN).set_index("parameter")
    table = report.tables.interior.set_index("parameter")
    assert float(rows.loc["c_mm", "initial"]) == BROWN.c
    c, sigma = table.loc["c_mm", ["value", "sigma"]].astype(float)
    assert float(rows.loc["c_mm", "value"]) == pytest.approx(c, abs=0.09 * sigma)
    assert float(rows.loc["c_mm", "sigma"]) == pytest.approx(sigma, rel=0.05)


def test_offsets_by_axis():
    table = part_report().images
    found = offset_statistics(table[table["position"] == "used"]).set_index("axis")
    d = OFFSETS_M[:3]
    np.testing.assert_allclose(found["mean_m"].astype(float), d.mean(axis=0), atol=5e-4)
    np.testing.assert_allclose(found["sd_m"].astype(float), d.std(axis=0, ddof=1), atol=5e-4)
    np.testing.assert_allclose(found["rms_m"].astype(float), np.sqrt((d**2).mean(axis=0)), atol=5e-4)
    np.testing.assert_allclose(found["largest_m"].astype(float), [0.3, 0.3, 0.3])
    assert found["image"].tolist() == ["i1", "i2", "i0"]
    assert len(offset_statistics(table[table["position"] == "none"])) == 0


def test_residuals_of_positions_are_held_against_their_sigmas():
    report = part_report()
    *_, rows = positions_section(report, source())
    a = report.part.adjusted
    w, axis = np.abs(np.asarray(a.residuals["stations"])), a.block.stations.axis
    for k, row in enumerate(rows.astype(str).to_numpy().tolist()):
        assert row[:3] == ["stations", "XYZ"[k], str((axis == k).sum())]
        assert row[5:] == [f"{100 * (w[axis == k] <= limit).mean():.0f} %" for limit in (1, 2, 3)]


def test_arrows_are_offsets_of_used_and_rejected_positions():
    axes = plot_position_offsets(part_report(), Figure().subplots())
    left, used = (child for child in axes.get_children() if isinstance(child, Quiver))
    mean = OFFSETS_M[:3, :2].mean(axis=0)
    np.testing.assert_allclose(np.stack([used.U, used.V], 1), OFFSETS_M[:3, :2] - mean)
    np.testing.assert_allclose(np.stack([left.U, left.V], 1), OFFSETS_M[3:, :2] - mean)
    assert used.scale == left.scale


def test_points_of_more_rays_are_surer():
    table = part_report().tables.object_points
    few, many = (table[table["n_images"] <= 3], table[table["n_images"] >= 5])
    assert few["sigma_Z_m"].median() > many["sigma_Z_m"].median()
    assert few["angle_deg"].median() < many["angle_deg"].median()


def test_the_summary_has_the_rows_of_every_part():
    report = part_report()
    rows = flight_summary([report, report], 9).set_index("quantity")
    for part in ("part 1", "part 2"):
        assert re.search(r"[\d.]+ ha by 2 images or more", rows.loc["area covered", part])


def test_the_spread_of_surveyed_points_is_of_those_that_have_the_axis():
    assert axis_cell(np.full(2, np.nan), np.nan) == ""
    assert axis_cell(np.array([0.25, np.nan]), 0.25) == "+0.250 / - / 0.250"
    assert axis_cell(np.array([0.1, np.nan, 0.3]), 0.2236) == f"+0.200 / {np.sqrt(0.02):.3f} / 0.224"


def test_provenance_is_silent_of_what_photographs_do_not_say():
    told = source()
    bare = told._replace(conditions=tuple(c._replace(time="") for c in told.conditions))
    names = lambda s: [name for e in provenance_section(s) if isinstance(e, dict) for name in e]  # noqa: E731
    assert "images taken" in names(told) and "images taken" not in names(bare)
    assert "exposure" not in names(told)


@pytest.mark.parametrize(
    ("make", "model", "camera"),
    [
        ("Canon", "Canon PowerShot SX260 HS", "Canon PowerShot SX260 HS"),
        ("NIKON CORPORATION", "NIKON D810", "NIKON D810"),
        ("DJI", "FC330", "DJI FC330"),
        ("", "FC330", "FC330"),
        ("DJI", "", "DJI"),
        ("", "", ""),
    ],
)
def test_a_maker_within_the_model_name_is_not_repeated(make, model, camera):
    assert Conditions("i", "i.jpg", "0" * 64, make=make, model=model).camera == camera


def test_a_smaller_part_tells_its_surveyed_points_and_its_lens():
    report = part_report()
    off = np.array([[0.1, 0.2, np.nan], [0.3, 0.2, np.nan]])
    marks = Marked(np.zeros(0, int), np.zeros(0, int), np.zeros((0, 2)), np.zeros(0))
    nothing = np.full((2, 3), np.nan)
    found = ControlledBlock(
        report.part.adjusted, ("q1", "q2"), np.zeros(2, bool), ("control", "control"), (3, 3), nothing, off, nothing,
        nothing, nothing, marks, np.zeros((0, 2)), ("two points were surveyed",),
    )  # fmt: skip
    part = report.part._replace(controlled=found, lens=("the lens is of a class",))
    html = flight_page([report, report._replace(part=part)], {}, {}, VERDICT, source(), ["r", "r2"])
    after = html[html.index(">Part 2</h2>") :]
    assert "Two points were surveyed." in after and "The lens is of a class." in after
    assert "+0.200 / 0.141 / 0.224" in after and not re.search(r"\bnan\b", after)
