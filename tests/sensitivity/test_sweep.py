"""Sweep: same results as separate adjustments, known effects of designs, tidy table and figures."""

import copy
import dataclasses
import importlib
import math
from pathlib import Path
from typing import Any

import equinox as eqx
import numpy as np
import pytest
from matplotlib.figure import Figure

import jaxphoto
from jaxphoto import FREE, DatumError, InputError, RankError
from jaxphoto.adjustment import PaddedSizes, common_sizes
from jaxphoto.adjustment.weak_directions import Yardsticks
from jaxphoto.report.sweep import plot_sweep, sweep_figure, sweep_table
from jaxphoto.report.verdict import verdict_of
from jaxphoto.sensitivity import sweep as side_by_side
from jaxphoto.sensitivity.sweep import Design, Sweep, sweep
from jaxphoto.statistics import correlations
from jaxphoto.workers import connected
from tests.checked_types import unchecked
from tests.simulation.small import SMALL, made

ARM = {"lever_arm_m": [0.1, -0.25, 0.8], "lever_arm": {"sigma_m": 0.01}}
# A second camera, whose interior orientation is known: correlations are means over the first one's images only.
OTHER = SMALL["cameras"]["kodak"] | {"interior": SMALL["cameras"]["kodak"]["truth"], "unknowns": {}}
STRIPS = [*SMALL["flight"]["strips"], {"name": "D", "camera": "other", "heading_deg": 165.0, "images": 3}]
BASE: dict[str, Any] = {
    "noise": None,
    "sigmas.attitude_deg": None,
    "mounts": {"default": ARM},
    "cameras.other": OTHER,
    "flight.strips": [strip | {"camera": strip.get("camera", "kodak")} for strip in STRIPS],
    "cameras.kodak.unknowns": dict.fromkeys(["c_mm", "xp_mm", "yp_mm", "k1", "k2"], "free"),
}
EXACT = dict.fromkeys(["image_mm", "control_m", "station_m"], 0.0)
UPRIGHT = {"jitter": {"position_m": [15.0, 15.0, 0.0]}, "terrain": {"kind": "flat"}, "noise": EXACT}
LOOSE = {"mounts": {"default": ARM | {"lever_arm": {"sigma_m": 1e9}}}}
DESIGNS: dict[str, dict[str, Any]] = {
    "base": {},
    "poor stations": {"sigmas.station_m": 0.5},
    "unknown arm": {"mounts": {"default": ARM | {"lever_arm": {"sigma_m": 0.5}}}},
    "no cross strip": {"flight.strips.2.heading_deg": 75.0, "flight.strips.2.along_bases": 0.0},
    "not turned": {"flight.strips.1.heading_deg": 75.0, "flight.strips.1.across_spacings": -0.5},
    "small": {"flight.strips.0.images": 3, "flight.strips.1.images": 3, "points.ties": 25},
    "no check points": {"targets": [{"count": 8, "role": "control"}]},
    "singular": UPRIGHT | LOOSE,
    "blunder": {"start.points_m": 1.0},
    "flat": {"terrain": {"kind": "flat"}, "sigmas.station_m": 50.0},
}
NAMES = list(DESIGNS)
STUDY = Path(__file__).resolve().parents[2] / "experiments" / "correlation_study"


def design(name: str, changes: dict[str, Any]) -> Design:
    block, truth, _ = made(copy.deepcopy(BASE) | changes)
    if name in ("unknown arm", "singular"):
        # A known camera would determine the lever arm: here all images are of the first one.
        block = dataclasses.replace(block, image_camera=("kodak",) * len(block.images))
    if name == "blunder":
        xy = block.image_points.xy.copy()
        xy[0] = 1e200
        block = eqx.tree_at(lambda b: b.image_points.xy, block, xy)
    return Design({"name": name, "images": len(block.images)}, block, truth)


@pytest.fixture(scope="module")
def designs() -> list[Design]:
    return [design(name, changes) for name, changes in DESIGNS.items()]


@pytest.fixture(scope="module")
def swept(designs: list[Design]) -> Sweep:
    return sweep(designs)


@pytest.mark.slow
def test_workers_give_the_same_statistics(designs, swept):
    pytest.importorskip("distributed", reason="distributed is not installed (extra cluster)")
    with connected(1, None) as client:
        again = sweep(designs, client=client)
    for name in ("converged", "steps", "redundancy", "sigma0", "sigma", "correlation", "mean_abs", "check_rmse"):
        np.testing.assert_array_equal(getattr(again, name), getattr(swept, name))
    assert (again.labels, again.weak, again.programs) == (swept.labels, swept.weak, swept.programs)


@pytest.fixture(scope="module")
def sizes(designs: list[Design]) -> PaddedSizes:
    return common_sizes(d.block for d in designs)


@pytest.mark.parametrize("name", ["base", "no cross strip", "small", "no check points"])
def test_every_number_is_that_of_the_design_alone(name, designs, swept, sizes):
    k = NAMES.index(name)
    block, truth = designs[k].block, designs[k].truth
    adjusted = jaxphoto.adjust(block, sizes=sizes)
    covariance = jaxphoto.covariance(adjusted)
    alone, sigma0 = correlations(adjusted, covariance)["kodak"], float(adjusted.sigma0)
    near = lambda ours, theirs: np.testing.assert_allclose(ours, theirs, rtol=1e-8, atol=1e-8)  # noqa: E731
    exactly = lambda ours, theirs: np.testing.assert_allclose(ours, theirs, rtol=1e-8, atol=0)  # noqa: E731

    assert swept.labels == adjusted.structure.labels
    assert swept.converged[k] and swept.determined[k]
    assert (swept.redundancy[k], swept.steps[k]) == (adjusted.redundancy, adjusted.steps)
    exactly(swept.sigma0[k], sigma0)
    exactly(swept.sigma[k] * sigma0, covariance.shared_sigma)
    iop = [label.startswith("interior") for label in swept.labels]
    near(swept.correlation[k][np.ix_(iop, iop)], alone.interior)
    near(swept.mean_abs[k][:, iop], alone.mean_abs)
    near(swept.max_abs[k][:, iop], alone.max_abs)
    exactly(swept.exterior_sigma[k] * sigma0, np.sqrt((covariance.exterior_sigma**2).mean(axis=0)))
    check = np.unique(block.check.who)
    if not len(check):
        assert np.isnan(swept.check_rmse[k]).all() and np.isnan(swept.check_sigma[k]).all()
        return
    off = np.asarray(adjusted.unknowns.points)[check] - truth.points[check]
    exactly(swept.check_rmse[k], np.sqrt((off**2).mean(axis=0)))
    exactly(swept.check_sigma[k] * sigma0, np.sqrt((covariance.point_sigma[check] ** 2).mean(axis=0)))


def test_designs_of_any_size_share_one_program(designs, swept):
    assert swept.programs == 1
    assert len({len(d.block.images) for d in designs}) > 1
    assert {"prepare", "compile", "designs"} <= swept.seconds.keys()


def test_unknowns_of_mounts_are_correlated_over_their_images(designs, swept, sizes):
    """For one mount of all images, its correlations are means over the whole block."""
    k = NAMES.index("unknown arm")
    adjusted = jaxphoto.adjust(designs[k].block, sizes=sizes)
    covariance = jaxphoto.covariance(adjusted)
    rho = jaxphoto.statistics.correlation_matrix(covariance)
    up, n = covariance.labels.index("mounts[default].lever_arm_up_m"), 6 * covariance.n_images
    of_images = np.abs(rho[:n, up]).reshape(-1, 6)
    np.testing.assert_allclose(swept.mean_abs[k][:, up - n], of_images.mean(axis=0), rtol=1e-8)


def test_known_laws(swept):
    label = {name.rpartition(".")[2]: k for k, name in enumerate(swept.labels)}
    c, x_p, y_p, up = label["c_mm"], label["xp_mm"], label["yp_mm"], label["lever_arm_up_m"]
    of = {name: k for k, name in enumerate(NAMES)}
    sigma, rho = swept.sigma, swept.mean_abs
    omega, phi = swept.eop_names.index("omega"), swept.eop_names.index("phi")
    # Station heights determine c if they and the lever arm are precise.
    assert sigma[of["poor stations"], c] > 1.3 * sigma[of["base"], c]
    assert sigma[of["unknown arm"], c] > 1.3 * sigma[of["base"], c]
    rho_c_up = np.abs(swept.correlation[:, c, up])
    assert rho_c_up[of["unknown arm"]] > 0.8 > 0.2 > rho_c_up[of["base"]]
    # Cross strips separate the principal point from the tilts.
    assert rho[of["no cross strip"], omega, y_p] > 1.2 * rho[of["base"], omega, y_p]
    # A strip flown the other way determines x_p better.
    assert sigma[of["not turned"], x_p] > 1.05 * sigma[of["base"], x_p]
    assert 0 < rho[of["base"], phi, x_p] < 1


def test_simulated_check_points_scatter_as_predicted(swept):
    ratio = swept.check_rmse / swept.check_sigma
    assert 0.4 < np.sqrt(np.nanmean(ratio**2)) < 2.0


def test_what_says_nothing_is_kept_and_marked(designs, swept, sizes):
    singular, blunder = NAMES.index("singular"), NAMES.index("blunder")
    assert np.flatnonzero(~swept.converged).tolist() == [blunder]
    assert np.flatnonzero(np.isnan(swept.sigma0) & swept.converged).tolist() == [singular]
    assert not swept.determined[singular]
    with pytest.raises(RankError, match="not separable"):
        jaxphoto.adjust(designs[singular].block, sizes=sizes)
    for k in (singular, blunder):
        for values in (swept.sigma0, swept.sigma, swept.correlation, swept.mean_abs, swept.check_rmse):
            assert np.isnan(values[k]).all()


@pytest.mark.parametrize("name", ["base", "flat"])
def test_a_design_is_determined_if_its_adjustment_has_no_warning(name, designs, swept, sizes):
    k = NAMES.index(name)
    verdict = verdict_of(jaxphoto.Tables(jaxphoto.adjust(designs[k].block, sizes=sizes)))
    assert swept.determined[k] == (verdict.colour == "green")
    assert swept.weak[k] == (("interior[kodak].c_mm",) if name == "flat" else ())
    assert np.isfinite(swept.sigma0[k])


def test_other_kinds_of_observations_are_another_program(monkeypatch):
    """Statistics come back in the order of the designs, with NaN where a design lacks an unknown."""
    without = {"mounts": {}, "sigmas.station_m": None}
    shifted = [{"strips": {strip: {"shift": {"sigma_m": 1.0}}}} for strip in "AB"]
    few = [design("", changes) for changes in ({}, without, DESIGNS["small"], *shifted)]

    def evaluate(prepared, rotations, max_steps, seconds):
        n, q = len(prepared), len(prepared[0].labels)
        numbers = np.array([design.redundancy for design in prepared])
        ones = np.ones((n, 6, q))
        return side_by_side.DesignStatistics(
            np.ones(n, bool), Yardsticks(np.ones(n), np.ones(n), ones[:, 0]), np.ones(n), numbers, 4.0 * numbers,
            np.tile(np.eye(q), (n, 1, 1)), ones[..., 0], ones, ones, np.ones(n), ones[:, :3, 0], ones[:, :3, 0],
        )  # fmt: skip

    monkeypatch.setattr(importlib.import_module("jaxphoto.sensitivity.sweep"), "evaluate", evaluate)
    swept = sweep(few)
    assert swept.programs == 3
    np.testing.assert_array_equal(swept.steps, swept.redundancy)
    np.testing.assert_allclose(swept.sigma0, 2.0)
    lacks = {"mounts": [1], "strips[A]": [0, 1, 2, 4], "strips[B]": [0, 1, 2, 3]}
    for owner, designs in lacks.items():
        theirs = np.array([label.startswith(owner) for label in swept.labels])
        assert theirs.sum() == 3
        nobody = np.isnan(swept.sigma[:, theirs])
        np.testing.assert_array_equal(nobody.T, [np.isin(np.arange(5), designs)] * 3)


def test_the_study_asks_of_blocks_that_one_program_serves(monkeypatch):
    """experiments/correlation_study: the first and the last design of every question."""
    monkeypatch.syspath_prepend(str(STUDY))
    study = importlib.import_module("study")
    assert 100 <= sum(math.prod(map(len, values.values())) for values in study.QUESTIONS.values()) <= 300
    for end in (0, -1):
        ends = {name: {p: v[end:][:1] for p, v in values.items()} for name, values in study.QUESTIONS.items()}
        monkeypatch.setattr(study, "QUESTIONS", ends)
        asked = study.designs()
        sizes = common_sizes(d.block for d in asked)
        assert [d.parameters["question"] for d in asked] == list(study.DRAWN)
        assert (
            len(
                side_by_side.group_by_program([side_by_side.prepare_design(d.block, d.truth, sizes, 25) for d in asked])
            )
            == 1
        )


def test_the_table_is_tidy(swept):
    table = sweep_table(swept)
    assert list(table.columns) == [
        "name",
        "images",
        "design",
        "converged",
        "determined",
        "weak",
        "quantity",
        "of",
        "value",
        "unit",
    ]
    assert not table.duplicated(["design", "quantity", "of"]).any()
    value = table.set_index(["name", "quantity", "of"])["value"]
    k, up = NAMES.index("unknown arm"), swept.labels.index("mounts[default].lever_arm_up_m")
    c = swept.labels.index("interior[kodak].c_mm")
    assert value["unknown arm", "sigma", "c_mm"] == swept.sigma[k, c]
    assert value["unknown arm", "rho", "c_mm:lever_arm_up_m"] == swept.correlation[k, c, up]
    assert value["base", "mean_abs_rho", "omega:c_mm"] == swept.mean_abs[0, 3, c]
    np.testing.assert_allclose(np.deg2rad(value["base", "rms_sigma", "omega_deg"]), swept.exterior_sigma[0, 3])
    units = table.drop_duplicates("of").set_index("of")["unit"]
    assert (units["c_mm"], units["X_m"], units["omega_deg"], units["k1"]) == ("mm", "m", "deg", "")
    silent = table[table["name"].isin(["singular", "blunder"])]
    assert silent["value"].isna().all() and (silent.groupby("name").size() == table.groupby("name").size().max()).all()
    assert not table[table["name"] == "no check points"]["quantity"].str.startswith("check").any()
    assert table[~table["name"].isin(["singular", "blunder"])]["value"].notna().all()


def test_names_that_are_not_unique_are_whole(swept):
    doubled = dataclasses.replace(swept, labels=tuple(f"interior[{k}].c_mm" for k in range(len(swept.labels))))
    assert "interior[0].c_mm" in set(sweep_table(doubled)["of"])


def test_pictures(swept):
    table = sweep_table(swept)
    figure = sweep_figure(table, "name", [("sigma", "c_mm"), ("mean_abs_rho", "omega:yp_mm")])
    line = figure.axes[0].lines[0]
    np.testing.assert_array_equal(line.get_ydata(), swept.sigma[:, swept.labels.index("interior[kodak].c_mm")])
    with pytest.raises(InputError, match="no column height"):
        sweep_figure(table, "height", [("sigma", "c_mm")])
    with pytest.raises(InputError, match="no sigma of k9"):
        sweep_figure(table, "name", [("sigma", "k9")])
    with pytest.raises(InputError, match="several designs have the same images"):
        sweep_figure(table, "images", [("sigma", "c_mm")])
    assert len(sweep_figure(table, "images", [("sigma", "c_mm")], by=["name"]).axes[0].lines) == len(NAMES)
    one = plot_sweep(table, "name", "sigma", "c_mm", Figure().add_subplot())
    np.testing.assert_array_equal(one.lines[0].get_ydata(), line.get_ydata())
    assert one.get_title() == figure.axes[0].get_title()


def test_mistakes_are_told_in_one_sentence(designs, swept):
    base = designs[0]
    with pytest.raises(InputError, match="needs at least one design"):
        sweep([])
    with pytest.raises(InputError, match=r"design 2 \(cross True\) has the parameters cross, but .* name, images"):
        sweep([base, base._replace(parameters={"cross": True})])
    fewer = eqx.tree_at(lambda b: b.priors.interior["kodak"].distortion.k2, base.block, jaxphoto.FIXED)
    with pytest.raises(InputError, match=r"design 2 .* estimates .*k1, but the first design .*k2: give all designs"):
        sweep([base, base._replace(block=fewer)])
    two = [{"count": 2, "role": "control"}]
    open_block = made(copy.deepcopy(BASE) | {"mounts": {}, "sigmas.station_m": None, "targets": two})
    with pytest.raises(DatumError, match=r"^design 2 \(name open, images 17\): "):
        sweep([base, Design({"name": "open", "images": 17}, open_block.block)])
    blind = eqx.tree_at(lambda b: b.priors.mounts["default"].boresight, base.block, FREE)
    with pytest.raises(RankError, match=r"^design 1 .*boresight is free"):
        sweep([base._replace(block=blind)])
    with pytest.raises(InputError, match=r"design 1 .* has true coordinates of 3 points, but its block has \d+"):
        sweep([base._replace(truth=eqx.tree_at(lambda t: t.points, base.truth, np.zeros((3, 3))))])
    with pytest.raises(ValueError, match="rotations must be one of"), unchecked():
        sweep([base], "euler")  # type: ignore[arg-type]
    renamed = dataclasses.replace(swept, parameters=tuple({"value": k} for k in range(len(swept))))
    with pytest.raises(InputError, match="design parameter value has the name of a table column"):
        sweep_table(renamed)
