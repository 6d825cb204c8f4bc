"""Variance components inflated by a few blunders are distinguished from wrong weights."""

import dataclasses

import numpy as np
import pytest

from jaxphoto import adjust, variance_components
from jaxphoto.procedures.snooping import inflated_components
from jaxphoto.report import component_findings
from tests.blocks import adjusted_example, example


@pytest.fixture(scope="module")
def block():
    return example()


def found_in(block):
    adjusted = adjusted_example() if block is example() else adjust(block)
    components = variance_components(adjusted, ("xy-z",))
    return components, inflated_components(adjusted, components, ("xy-z",))


def test_the_component_that_one_wrong_height_makes_is_an_alarm(block):
    control = block.control
    row = np.flatnonzero((control.who == block.points.index("T11")) & (control.axis == 2))
    value = np.array(control.value)
    value[row] += 2.0
    components, (made,) = found_in(
        block.with_observations({"control_points": dataclasses.replace(control, value=value)})
    )
    assert made.label == "control_points Z" and made.words == ("control point T11 in Z",)
    assert made.factor == components.factor[components.labels.index(made.label)] > 50
    # As in the block without the error, whose control heights are as good as stated.
    assert made.without == pytest.approx(1.0, abs=0.5)
    alarm = component_findings(components, [made])[0]
    assert alarm.severity == "error" and "T11 in Z" in alarm.text and "--snoop" in alarm.text


def test_sigmas_that_were_stated_too_small_are_not(block):
    control = block.control
    off = np.random.default_rng(4).normal(0.0, 0.5, len(control))
    worse = dataclasses.replace(control, value=np.asarray(control.value) + off)
    components, made = found_in(block.with_observations({"control_points": worse}))
    assert (components.factor > 4).any()
    assert not made


def test_nothing_is_made_of_a_sound_block(block):
    assert not found_in(block)[1]
