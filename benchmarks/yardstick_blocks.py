"""The blocks whose results `yardstick.py` stores, by case: seeded, and independent of the solver.

A case is a function under `@case` that returns one block or several. Those of real measurements raise NoDataError where
these are absent.
"""

import contextlib
import dataclasses
import importlib.util
import os
import tempfile
import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from unittest import mock

import equinox as eqx
import numpy as np
import pandas as pd
from optimum import optimum

import jaxphoto
from jaxphoto import Block
from jaxphoto.io import recipe_from

ROOT = Path(__file__).resolve().parents[1]

Blocks = Mapping[str, Block]
CASES: dict[str, Callable[[], Blocks]] = {}


class NoDataError(Exception):
    """Real measurements are absent."""


def case(build: Callable[[], Blocks]) -> Callable[[], Blocks]:
    """Register a builder under its name."""
    CASES[build.__name__] = build
    return build


def _resolved():
    """Blocks of procedures that look at a cloud from where an adjustment puts points: from the optimum itself."""
    stack = contextlib.ExitStack()
    for module in ("iterate_to_convergence", "strip_adjustment"):
        stack.enter_context(mock.patch(f"jaxphoto.procedures.lidar.{module}.adjust", optimum))
    return stack


@case
def cross_block() -> Blocks:
    return {"P31": jaxphoto.read_block(ROOT / "examples" / "cross_block")}


@case
def large() -> Blocks:
    from blocks import SIZES, generate
    from ours import block_of

    return {"B200": block_of(generate(SIZES["B200"]), "B200")}


@case
def single_image_cameras() -> Blocks:
    """A camera of nine unknowns an image, as in "Bundle Adjustment in the Large"."""
    from blocks import generate, parallel_strips
    from ours import block_of

    block = block_of(generate(parallel_strips(4, 5, 1500)), "BAL")
    start, priors = (dataclasses.replace(u, interior=dict.fromkeys(block.images, u.interior["cam"]))
                     for u in (block.start.unknowns, block.priors))  # fmt: skip
    return {
        "BAL": dataclasses.replace(
            block,
            sensors=dict.fromkeys(block.images, block.sensors["cam"]),
            image_camera=block.images,
            start=dataclasses.replace(block.start, unknowns=start),
            priors=priors,
        ).fix("xp_mm").fix("yp_mm")
    }  # fmt: skip


def _experiment(name: str, *variants: str) -> Blocks:
    """The first layout of an experiment, in the variants named or all."""
    from jaxphoto.experiment import simulated
    from jaxphoto.experiment.experiment import load_experiment

    folder = ROOT / "experiments" / name
    experiment = load_experiment(folder)
    return {v: experiment.variants[v].change(simulated(experiment, folder, v).block)
            for v in variants or experiment.variants}  # fmt: skip


def _script(path: str):
    """The module of a study."""
    spec = importlib.util.spec_from_file_location(Path(path).stem, ROOT / "experiments" / path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@case
def experiment_000() -> Blocks:
    return _experiment("000", "first", "fourth")


@case
def experiment_002() -> Blocks:
    return _experiment("002", "target1", "uav")


@case
def experiment_003() -> Blocks:
    return _experiment("003", "A/3", "B/3")


@case
def experiment_004() -> Blocks:
    return _experiment("004", "system/1", "independent/1", "test field")


@case
def experiment_systematics() -> Blocks:
    return _experiment("systematics", *(f"{error}, free" for error in ("time offset", "drift")))


@case
def experiment_posterior() -> Blocks:
    recipe = tomllib.loads((ROOT / "benchmarks/yardstick/flat_block.toml").read_text(encoding="utf-8"))
    blocks = {"without stations": jaxphoto.simulate(recipe_from(recipe), seed=1).block}
    recipe["sigmas"]["station_m"] = recipe["noise"]["station_m"] = 0.1
    return blocks | {"with stations": jaxphoto.simulate(recipe_from(recipe), seed=1).block}


@case
def experiment_correlation_study() -> Blocks:
    from jaxphoto.experiment import Experiment, Variant, simulated

    study = _script("correlation_study/study.py")
    changes = {"usual": {}, "oblique": {"tilt_deg": 20.0}}
    variants = {name: Variant(recipe=study.recipe_of({**study.BASE, **change})) for name, change in changes.items()}
    asked = Experiment(title="", variants=variants, tables={})
    return {name: simulated(asked, study.FOLDER, name).block for name in variants}


@case
def experiment_network_design() -> Blocks:
    design = _script("network_design/design.py")
    of, usual = design.plan(0), design.design_from_plan(design.RECIPE.plan, design.CENTRE)
    known = design.designs_of(pd.read_csv(ROOT / "experiments/network_design/layouts.csv"), usual)
    measured = {name: design.block_from_layout(of(known[name])) for name in ("usual", "headings")}
    return {name: design.noisy(m.block, m.truth)(0) for name, m in measured.items()}


@case
def experiment_lidar_only() -> Blocks:
    from jaxphoto.lidar import HeightSettings, index_cloud
    from jaxphoto.procedures.lidar import lidar_control

    study = _script("lidar_only/study.py")
    flight = jaxphoto.simulate(jaxphoto.read_recipe(study.FOLDER / "recipe.toml"), 1)
    grid, settings = index_cloud(flight.cloud), HeightSettings(sigma_z_m=0.15, sigma_xy_m=0.5)
    with _resolved():
        found = {name: lidar_control(variant(flight.block), grid, "plane", settings, max_rounds=1)
                 for name, variant in study.EXPERIMENTS.items()}  # fmt: skip
    return {name: one.block for name, one in found.items()}


@case
def experiment_joint_flight() -> Blocks:
    from jaxphoto.procedures.lidar import Photographs, adjust_strips

    study = _script("joint_flight/manoeuvres.py")
    manoeuvres = tomllib.loads((study.FOLDER / "manoeuvres.toml").read_text(encoding="utf-8"))["manoeuvre"]
    flight = jaxphoto.simulate(study.planned(manoeuvres[0]["strips"]), seed=5)
    photographs = Photographs(flight.block, np.asarray(flight.block.flight_time))
    with _resolved():
        found = adjust_strips(flight.cloud, flight.trajectory, study.SETTINGS, study.PRIORS,
                              photographs=photographs, max_rounds=1)  # fmt: skip
    return {manoeuvres[0]["name"]: found.adjusted.block}


@case
def strips_with_splines() -> Blocks:
    from jaxphoto.procedures.lidar import adjust_strips
    from tests.procedures.strips import PRIORS, SETTINGS, flown

    flight = flown()
    with _resolved():
        return {"strips": adjust_strips(flight.cloud, flight.trajectory, SETTINGS, PRIORS, max_rounds=1).adjusted.block}


def _tests(*names: str) -> Blocks:
    """Small blocks of the tests. They start at their truth: the datum of free networks is about a start."""
    from tests.blocks import simulated

    made = {name: simulated(name) for name in names}
    return {name: eqx.tree_at(lambda b: b.start.unknowns, block, truth) for name, (block, truth) in made.items()}


@case
def free_network() -> Blocks:
    return _tests("inner", "inner_shift")


@case
def several_cameras() -> Blocks:
    return _tests("two_cameras", "three_models")


@case
def georeferenced() -> Blocks:
    return _tests("everything", "fixed_control")


@case
def lidar_surfaces() -> Blocks:
    return _tests("surfaces")


@case
def test_field() -> Blocks:
    return _tests("field", "field_and_ground")


@case
def changing_cameras() -> Blocks:
    import live_cameras

    return {name: jaxphoto.simulate(recipe_from(live_cameras.FLIGHT | live_cameras.CASES[name]), 1).block
            for name in ("strips", "spline")}  # fmt: skip


@case
def rig() -> Blocks:
    import rig

    return {"rig": jaxphoto.simulate(recipe_from(rig.RECIPE), 1).block}


@case
def fisheye() -> Blocks:
    from tests.test_fisheye import SIGMA_MM, folder_of

    with tempfile.TemporaryDirectory() as folder:
        return {"dome": jaxphoto.read_block(folder_of(Path(folder) / "dome", SIGMA_MM))}


@case
def rolling_shutter() -> Blocks:
    from rolling_shutter import flown

    return {"drone": flown(1, cross=True, knows=True).block}


def _measured(folder: str) -> Path:
    """A folder of real measurements. Raises NoDataError where it is absent."""
    data = (ROOT / os.environ.get("JAXPHOTO_DATA", "../shared/data")).resolve()
    if not (data / folder).is_dir():
        raise NoDataError(f"no {folder} in {data}: set JAXPHOTO_DATA to the folder of real measurements")
    return data / folder


@case
def real_sxb() -> Blocks:
    folder = _measured("sxb")
    return {"sxb": jaxphoto.read_source(folder),
            "stations": jaxphoto.read_source(folder / "prior_eo", "photomodeler")}  # fmt: skip


@case
def real_camcal() -> Blocks:
    return {"camcal": jaxphoto.read_source(_measured("camcal"))}


@case
def real_aicon() -> Blocks:
    from tests.aicon import read_aicon

    return {"aicon": read_aicon(_measured("aicon"))}


@case
def real_mrcal_board() -> Blocks:
    from test_field import board_block

    return {"board": board_block(pd.read_csv(_measured("mrcal_board") / "corners.csv"))}
