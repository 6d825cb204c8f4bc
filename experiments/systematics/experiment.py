"""Every systematic error that can be simulated: found where its parameter is free, and what it does where it is not."""

from collections.abc import Mapping
from typing import Any

from jaxphoto.experiment import Experiment, Variant, effects, recovered
from jaxphoto.observations import AXES
from jaxphoto.variants import common_shift

Recipe = Mapping[str, Any]


def mount(key: str, truth: Any, parameter: str) -> tuple[Recipe, Recipe]:
    """Return an unmodelled error of the mount, and the variant with its parameter free."""
    ignored = {"truth": {key: truth}}
    return {"mounts": {"default": ignored}}, {"mounts": {"default": ignored | {parameter: "free"}}}


def strips(key: str, truths: Mapping[str, list[float]], parameter: str) -> tuple[Recipe, Recipe]:
    """Return an unmodelled error per strip, and the variant with its parameter free."""
    ignored = {strip: {"truth": {key: truth}} for strip, truth in truths.items()}
    return {"strips": ignored}, {"strips": {strip: table | {parameter: "free"} for strip, table in ignored.items()}}


SHIFTS = {"E1": [0.8, -0.6, 2.0], "E2": [-0.7, 0.5, 1.8], "N1": [0.6, 0.9, -2.2], "N2": [-0.9, -0.7, -2.4]}
DRIFTS = {"E1": [0.03, -0.02, 0.03], "E2": [0.02, 0.03, -0.03], "N1": [-0.03, 0.02, 0.03], "N2": [0.03, -0.02, 0.04]}
OFFSET = {"truth": {"datum_offset_m": [-0.6, 0.5, 0.9]}}
ERRORS = {
    "lever arm": mount("lever_arm_m", [0.6, -0.9, 1.3], "lever_arm"),
    "boresight": mount("boresight_deg", [-0.14, 0.08, -0.19], "boresight"),
    "time offset": mount("time_offset_s", 0.02, "time_offset"),
    "shift": strips("shift_m", SHIFTS, "shift"),
    "drift": strips("drift_m_per_s", DRIFTS, "drift"),
}
variants = {"none": Variant(), "datum offset, ignored": Variant(recipe=OFFSET)}
variants["datum offset, free"] = Variant(common_shift, OFFSET)
for name, (ignored, free) in ERRORS.items():
    variants[f"{name}, ignored"] = Variant(recipe=ignored)
    variants[f"{name}, free"] = Variant(recipe=free)
names = [*ERRORS, "datum offset"]

EXPERIMENT = Experiment(
    title="Systematic errors, each by itself: found where it is modelled, what it does where it is not",
    variants=variants,
    tables={
        "recovered": recovered(
            {name: f"{name}, free" for name in names},
            {f"strips[block].shift_{axis}_m": f"datum_offset_{axis}_m" for axis in AXES},
        ),
        "effect": effects({"none": "none"} | {name: f"{name}, ignored" for name in names}, "none"),
    },
    layouts=10,
)
