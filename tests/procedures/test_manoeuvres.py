"""The flights of experiments/joint_flight/manoeuvres.py."""

import runpy
import tomllib
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "experiments" / "joint_flight"


def test_manoeuvres_can_be_flown_with_as_many_photographs():
    planned = runpy.run_path(str(FOLDER / "manoeuvres.py"))["planned"]
    ways = tomllib.loads((FOLDER / "manoeuvres.toml").read_text(encoding="utf-8"))["manoeuvre"]
    recipes = [planned(way["strips"]) for way in ways]
    assert len(recipes) == 8 and {sum(strip["images"] for strip in way["strips"]) for way in ways} == {12}
    heights = [sorted({strip.height_m for strip in recipe.plan.strips}) for recipe in recipes]
    assert heights.count(pytest.approx([300.0, 500.0])) == 3
