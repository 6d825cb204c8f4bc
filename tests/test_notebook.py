"""What a notebook asks of things: how they show themselves, priors by name, pictures, two adjustments compared."""

import dataclasses
import enum
import inspect
import os
import subprocess
import sys
import typing
from pathlib import Path

import jax
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

import jaxphoto
from jaxphoto import FIXED, FREE, InputError, Tables, Weighted, report
from jaxphoto.io.block_folder.table_layout import ANGLES, XYZ
from jaxphoto.losses import AbstractLoss
from jaxphoto.procedures.boresight import BoresightEstimate, Step
from jaxphoto.procedures.georeference import Georeferenced
from jaxphoto.procedures.robust import Robust
from jaxphoto.procedures.snooping import Exchange, Snooped
from jaxphoto.report.findings import Verdict
from jaxphoto.sensitivity import Readjustment
from jaxphoto.simulation import Simulation, Terrain
from jaxphoto.stability import Change
from tests.blocks import adjusted, simulated

PANELS = (
    "plot_residuals", "plot_mean_residuals", "plot_check_points", "plot_interior_correlation",
    "plot_exterior_correlation", "plot_sigma_map", "plot_distortion", "plot_error_ellipses", "plot_residuals_by_radius",
    "plot_station_residuals", "plot_convergence", "plot_intersection_angles",
    "plot_overlap", "plot_links",
)  # fmt: skip


@pytest.fixture
def axes():
    """Those of a figure that needs no screen."""
    return Figure().add_subplot()


def test_things_show_themselves_in_a_few_lines():
    block, result = simulated("everything").block, adjusted("everything")
    shown = [block, result, result.unknowns, result.priors, *block.sensors.values(), *result.unknowns.interior.values()]
    for thing in shown:
        assert len(repr(thing)) < 2500 and len(repr(thing).splitlines()) < 20
        assert thing._repr_html_().startswith(("<b>", "Adjustment")) and "<script" not in thing._repr_html_()
    assert "c_mm 35.1" in repr(simulated("cross").truth.interior["one"])
    assert "k1 FREE" in repr(adjusted("cross").priors)
    evil = dataclasses.replace(block, title="<script>")
    assert "&lt;script&gt;" in evil._repr_html_()


ROOMS = (jaxphoto, jaxphoto.statistics, jaxphoto.stability, jaxphoto.sensitivity)
PROCEDURES = {BoresightEstimate, Exchange, Georeferenced, Robust, Snooped, Step}


def classes_in(hint) -> set[type]:
    """Those of jaxphoto in an annotation."""
    inside = set().union(*(classes_in(part) for part in typing.get_args(hint)))
    ours = inspect.isclass(hint) and hint.__module__.startswith("jaxphoto") and not typing.get_origin(hint)
    return inside | ({hint} if ours else set())


def returned() -> set[type]:
    """What public functions return, public classes, and what blocks, adjustments and simulations consist of."""
    found: set[type] = set(PROCEDURES)
    for thing in (getattr(room, name) for room in ROOMS for name in room.__all__):
        if inspect.isclass(thing):
            found.add(thing)
        elif inspect.isfunction(thing):
            found |= classes_in(typing.get_type_hints(thing).get("return"))
    for whole in (jaxphoto.Block, jaxphoto.Adjustment, jaxphoto.Unknowns, Simulation, Change):
        found |= {c for hint in typing.get_type_hints(whole).values() for c in classes_in(hint)}
        own = [p.fget for _, p in inspect.getmembers(whole, lambda p: isinstance(p, property))]
        # Types of what upstairs makes are not known down here.
        found |= {c for get in own for c in classes_in(typing.get_type_hints(get).get("return"))}
    return found


def test_whatever_the_public_functions_return_shows_itself_in_a_notebook():
    plain = (BaseException, enum.Enum, Readjustment, AbstractLoss)
    mute = {c.__name__ for c in returned() if not issubclass(c, plain) and not hasattr(c, "_repr_html_")}
    assert not mute and hasattr(Verdict, "_repr_html_") and len(returned()) > 100


def test_what_is_returned_is_short_and_a_table():
    block, result = simulated("cross").block, adjusted("cross")
    tables = Tables(result)
    things = [
        jaxphoto.compare(result, result), result.padded, result.padded_values, result.equations,
        result.structure, result.values, result.residuals, result.factored, block.start, block.datum, block.stations,
        result.verdict(), result.unknowns.exterior, tables.covariance, tables.redundancy, tables.correlations["one"],
        jaxphoto.bias(block, "station", 0.1), jaxphoto.sigma_map(result, "one"), Weighted(1.0, 0.1),
    ]  # fmt: skip
    for thing in things:
        assert len(repr(thing)) < 1500 and len(repr(thing).splitlines()) < 15, type(thing)
        shown = thing._repr_html_()
        assert shown.startswith("<b>") and shown.count("<table") == shown.count("</table>") > 0 and len(shown) < 8000
    assert "<th>difference</th>" in things[0]._repr_html_() and "c_mm" in things[0]._repr_html_()
    # Whatever stands for an array while JAX maps over it.
    odd = jax.tree.map(lambda _: object(), result.values)
    assert repr(odd).startswith("Values(") and "<table" in odd._repr_html_()


def test_an_adjustment_that_fits_nothing_says_so_and_its_verdict_reads_as_sentences():
    sound = adjusted("cross")
    assert "expected" not in repr(sound)
    rows = sound.block.stations
    off = np.asarray(rows.value) + np.where(rows.axis == 2, 20.0, 0.0)
    bad = jaxphoto.adjust(sound.block.with_observations({"stations": dataclasses.replace(rows, value=off)}))
    assert "(expected 1 +- 0." in repr(bad) and "see .verdict()" in repr(bad)
    assert "(expected 1 +- 0." in bad._repr_html_()
    said = repr(bad.verdict()).splitlines()
    assert said[0].startswith("red: ") and said[1].startswith("!! ") and len(said) == 1 + len(bad.verdict().findings)


def test_tables_name_what_they_have():
    tables = Tables(adjusted("cross"))
    assert {"interior", "residuals", "sigma_map", "check_points"} <= set(
        repr(tables).split("\n")[-1].strip().split(", ")
    )
    assert tables._repr_html_().count("<table") == 3


def test_priors_are_changed_by_name_and_the_block_stays():
    block = simulated("cross").block
    held = block.fix("k2")
    assert held.priors.interior["one"].distortion.k2 == FIXED
    assert block.priors.interior["one"].distortion.k2 == FREE
    assert held.priors.interior["one"].distortion.k1 == FREE
    again = held.free("k2", "p1")
    assert again.priors.interior["one"].distortion.k2 == FREE and again.priors.interior["one"].distortion.p1 == FREE
    assert block.fix("position").priors.exterior.position == FIXED
    near = block.weigh("c", 0.02).priors.interior["one"].c
    assert isinstance(near, Weighted)
    assert (near.value, near.sigma) == (block.start.unknowns.interior["one"].c, 0.02)
    assert block.weigh("xp", 0.1, value=0.5).priors.interior["one"].xp.value == 0.5
    # A weighted parameter can be held, too.
    assert block.weigh("c", 0.02).fix("c_mm").priors.interior["one"].c == FIXED


def test_of_several_owners_one_is_named_or_all_are_meant():
    block = simulated("everything").block
    cameras = [name for name, own in block.priors.interior.items() if "k1" in own.distortion.coefficients]
    held = block.fix("c_mm", of=cameras[0]).priors.interior
    assert held[cameras[0]].c == FIXED
    assert all(held[name] == block.priors.interior[name] for name in held if name != cameras[0])
    assert all(own.c == FIXED for own in block.fix("c").priors.interior.values())
    mount = next(iter(block.priors.mounts))
    assert block.fix("boresight").priors.mounts[mount].boresight == FIXED
    assert block.weigh("lever_arm", 0.01).priors.mounts[mount].lever_arm.sigma == 0.01


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (
            lambda b: b.fix("k9"),
            r"unknown parameter 'k9'; choose among c_mm, xp_mm, .*k1.* position, rotation",
        ),
        (lambda b: b.free("k1", of="sony"), "unknown parameter owner 'sony'; use one of one"),
        (lambda b: b.fix("a1", of="one"), "unknown parameter 'a1' of 'one'; choose among c_mm"),
        (lambda b: b.fix("points", of="one"), "points has one prior for the whole block, not one of 'one'"),
        (lambda b: b.fix(), "no parameter given: give names"),
        (lambda b: b.free(""), "'' is not a parameter name: give names"),
        (lambda b: b.fix(["k1", "k2"]), r"\['k1', 'k2'\] is not a parameter name: give names separated by commas"),
        (lambda b: b.weigh("points", 0.1), r"weigh\('points'\) needs a value with its sigma"),
        (lambda b: b.weigh("c", -1), r"c: its sigma is -1: give a positive one, or fix .* fix\('c'\)"),
        (lambda b: b.weigh("c", 0), "c: its sigma is 0: give a positive one"),
        (lambda b: b.weigh("c", float("nan")), "c: its sigma is nan: give a finite number"),
        (lambda b: b.weigh("c", None), "c: its sigma is None: give a finite number"),
        (lambda b: b.weigh("c", 0.1, value=np.inf), "c: its value is inf: give a finite number"),
        (lambda b: b.weigh("c", [0.1, 0.2]), r"c: its sigma is an array of the shape \(2,\): give one number$"),
        (
            lambda b: b.weigh("position", 0.1, np.zeros((2, 2))),
            r"position: its value is an array of the shape \(2, 2\): give one number, or an array of the shape",
        ),
    ],
)
def test_what_is_not_there_is_named(call, message):
    with pytest.raises(InputError, match=message):
        call(simulated("cross").block)


def test_all_pictures_take_and_return_axes_by_one_name():
    pictures = [jaxphoto.Block.plot, jaxphoto.Adjustment.plot]
    pictures += [getattr(report, name) for name in report.__all__ if name.startswith("plot_")]
    for plot in pictures:
        signature = inspect.signature(plot)
        assert str(signature.parameters["ax"].annotation) in ("Axes | None", "Axes"), plot
        assert signature.return_annotation == "Axes", plot


@pytest.mark.slow
def test_a_users_script_has_types(tmp_path):
    """What mypy sees of the public names, from outside."""
    shown = {
        "block.plot()": "Axes", "block.fix('k2')": "Block", "adjusted.plot()": "Axes", "adjusted.verdict()": "Verdict",
        "jaxphoto.compare(adjusted, adjusted)": "Change", "jaxphoto.Tables(adjusted).interior": "DataFrame",
        "jaxphoto.simulate(jaxphoto.read_recipe('r.toml'))": "Simulation",
        "jaxphoto.monte_carlo(adjusted, jaxphoto.bias(block, 'station', 0.1), 50)": "Draws",
    }  # fmt: skip
    script = tmp_path / "script.py"
    start = "import jaxphoto\nblock = jaxphoto.read_block('b')\nadjusted = jaxphoto.adjust(block)\n"
    script.write_text(start + "".join(f"reveal_type({call})\n" for call in shown))
    checked = (sys.executable, "-m", "mypy", "--strict", "--config-file=", f"--cache-dir={tmp_path}", script)
    path = os.environ | {"MYPYPATH": str(Path(jaxphoto.__file__).parents[1])}
    done = subprocess.run(checked, capture_output=True, text=True, check=False, cwd=tmp_path, env=path)
    said = [line for line in done.stdout.splitlines() if "script.py" in line]
    assert len(said) == len(shown) and not any(": error:" in line for line in said), done.stdout + done.stderr
    for line, kind in zip(said, shown.values(), strict=True):
        assert line.split('"')[1].rstrip("]").split(".")[-1] == kind, line


@pytest.mark.parametrize("name", PANELS)
def test_each_picture_is_drawn_on_the_axes_that_are_given(name, axes):
    tables = Tables(adjusted("cross"))
    assert getattr(report, name)(tables, ax=axes) is axes
    assert axes.has_data() and (axes.get_title() or axes.get_title(loc="left"))
    axes.figure.draw_without_rendering()


def test_a_block_is_drawn_as_it_starts_and_as_it_ended(axes):
    result = adjusted("cross")
    assert result.plot(ax=axes) is axes
    stations = next(line for line in axes.lines if line.get_label() == "camera stations")
    np.testing.assert_array_equal(np.stack(stations.get_data(), 1), result.unknowns.exterior.position[:, :2])
    before = Figure().add_subplot()
    simulated("cross").block.plot(ax=before)
    assert "before" in before.get_title(loc="left")
    start = next(line for line in before.lines if line.get_label() == "control points")
    assert len(start.get_xdata()) == len(np.unique(result.block.control.who))


def test_of_a_block_without_start_values_observed_positions_are_drawn(axes):
    block = simulated("cross").block
    unknown = dataclasses.replace(
        block.start, image_known=np.zeros(len(block.images), bool), point_known=np.zeros(len(block.points), bool)
    )
    dataclasses.replace(block, start=unknown).plot(axes)
    stations = next(line for line in axes.lines if line.get_label() == "camera stations")
    x = block.stations.value[block.stations.axis == 0]
    np.testing.assert_array_equal(stations.get_xdata(), x)


def test_in_space_each_image_has_its_frame():
    axes = Figure().add_subplot(projection="3d")
    result = adjusted("cross")
    result.plot(ax=axes, in_3d=True)
    frames = [line for line in axes.lines if len(line.get_data_3d()[0]) == 13]
    assert len(frames) == len(result.block.images)
    # Below the projection centre, as far as it looks down.
    z = np.array([np.asarray(line.get_data_3d())[2] for line in frames])
    assert (z[:, :4].max(axis=1) < np.asarray(result.unknowns.exterior.position)[:, 2]).all()
    with pytest.raises(InputError, match="in_3d needs 3D axes"):
        result.plot(Figure().add_subplot(), in_3d=True)


def test_two_adjustments_of_one_block_are_alike_and_of_another_camera_are_not():
    one = adjusted("cross")
    same = jaxphoto.compare(one, one)
    assert same.chi_square == 0 and not same.beyond.any()
    moved = dataclasses.replace(one.unknowns.interior["one"], xp=one.unknowns.interior["one"].xp + 0.2)
    unknowns = dataclasses.replace(one.unknowns, interior={"one": moved})
    other = jaxphoto.compare(one, dataclasses.replace(one, unknowns=unknowns), method="zrot")
    (row,) = [p for p in other.parameters if p.parameter == "xp_mm"]
    assert row.difference == pytest.approx(0.2) and other.beyond.all() and other.p_parameters < 1e-6
    with pytest.raises(InputError, match="unknown camera two"):
        jaxphoto.compare(one, one, camera="two")


def test_an_adjustment_is_set_beside_the_truth():
    """By how many standard deviations, as a calculation by hand has it."""
    result, truth = adjusted("cross"), simulated("cross").truth
    angles = Tables(dataclasses.replace(result, unknowns=truth)).exterior[list(ANGLES)].to_numpy()
    exterior = pd.DataFrame(np.hstack([truth.exterior.position, angles]), columns=[*XYZ, *ANGLES])
    exterior.insert(0, "image", result.block.images)
    exterior.loc[0, "kappa_deg"] += 360.0
    interior = pd.DataFrame({"camera": "one", "parameter": ["c_mm", "k9"], "value": [truth.interior["one"].c, 1.0]})
    tables = Tables(result, truth={"interior": interior, "exterior": exterior})
    found = tables.recovery.set_index("parameter")
    assert len(found) == 1 + 6 * len(result.block.images)
    c = tables.interior.set_index("parameter").loc["c_mm"]
    assert found.loc["interior[one].c_mm", "ratio"] == pytest.approx((c.value - 35.1) / c.sigma)
    assert np.abs(found["ratio"]).max() < 5
    assert {label.rpartition(".")[2]: unit for label, unit in found["unit"].items()} == {
        "c_mm": "mm", **dict.fromkeys(XYZ, "m"), **dict.fromkeys(ANGLES, "deg"),
    }  # fmt: skip
    spread = report.recovery_spread(tables.recovery).set_index("group")
    assert list(spread.index) == ["interior[one]", *(f"exterior {name}" for name in (*XYZ, *ANGLES))]
    assert spread.loc["exterior X_m", "n"] == 10
    z = found[found.index.str.endswith("Z_m")]["ratio"]
    assert spread.loc["exterior Z_m", "rms_ratio"] == pytest.approx(np.sqrt((z**2).mean()))
    assert Tables(result).recovery.empty


def test_a_comparison_and_a_simulation_say_what_they_are():
    one, made = adjusted("cross"), simulated("cross")
    same = jaxphoto.compare(one, one)
    for shown in (repr(same), same._repr_html_()):
        assert "no significant change of the camera" in shown and "at 0 of 165 points" in shown
    moved = dataclasses.replace(one.unknowns.interior["one"], xp=one.unknowns.interior["one"].xp + 0.2)
    unknowns = dataclasses.replace(one.unknowns, interior={"one": moved})
    other = jaxphoto.compare(one, dataclasses.replace(one, unknowns=unknowns))
    assert other.changed and "the camera has changed significantly" in other._repr_html_()
    whole = Simulation(made.block, made.truth, np.zeros(3), Terrain())
    assert repr(whole) == f"Simulation with its truth, of {made.block!r}"
    assert "10 of 1 camera" in whole._repr_html_() and "true camera one" in whole._repr_html_()
