"""Weak determination of c and the principal point of a flat block without stations is reported."""

import dataclasses
import functools

import jax
import numpy as np
import pytest

from jaxphoto import Tables, adjust
from jaxphoto.observations import CameraPositions
from jaxphoto.report import verdict_of
from tests.blocks import BROWN, CONTROL, Scene, Simulated, aerial, all_stations, bare, free, measured, rows


@functools.cache
def tables(relief: float, stations: bool | float, names=("c_mm", "xp_mm", "yp_mm")):
    """The aerial block with its relief (150 m at a height of 1000 m) times `relief`, flown at one height.

    `stations` may be their sigma (m).
    """
    scene = aerial()
    positions = scene.positions * [1, 1, 0] + [0, 0, 1000.0]
    built, truth = bare(Scene(positions, scene.angles, scene.points * [1, 1, relief]), {"one": BROWN}, ("one",) * 10)
    observed = all_stations(built, 0.10 if stations is True else stations) if stations else CameraPositions.none()
    built = dataclasses.replace(built, control=rows(CONTROL), stations=observed)
    return Tables(adjust(measured(Simulated(free(built, "one", names), truth)).block))


@pytest.mark.slow
def test_a_harmless_high_correlation_has_no_remedy():
    """Stations that all shift alike: Z and c go together, and c is known well enough."""
    said = [f for f in verdict_of(tables(0.1, 1.0)).findings if "Z with c " in f.text]
    assert [(f.code, f.severity) for f in said] == [("correlation_exterior", "note")] and "10 sigma" in said[0].hint


def weak(warnings):
    return [w for w in warnings if "poorly determined" in w]


def test_flat_ground_without_stations_is_reported():
    found = verdict_of(tables(0.1, False)).texts
    c, point = weak(found)
    assert found[:2] == [c, point]
    assert c.startswith("c of camera one")
    assert all(cure in c for cure in ("stations (GNSS)", "relief", "second flying height", "oblique", "fix c"))
    significance = {s.parameter: s for s in tables(0.1, False).significance}
    rho = tables(0.1, False).correlations["one"].max_abs
    assert f"sigma {significance['c_mm'].sigma:.3g} mm" in c
    assert f"up to {rho[2, 0]:.4f}" in c
    assert rho[2, 0] > 0.99
    assert "relief 1 %" in c or "relief 2 %" in c
    assert point.startswith("the principal point of camera one")
    assert f"sigma of y_p {significance['yp_mm'].sigma:.3g} mm" in point
    assert f"omega and phi up to {rho[3:5, 1:].max():.4f}" in point
    assert all(cure in point for cure in ("stations (GNSS)", "relief", "oblique", "fix it"))
    # Said once: no second warning of the same pairs.
    for pair in ("Z with c ", "X with x_p", "Y with x_p", "X with y_p", "Y with y_p"):
        assert not any(pair in w for w in found)


def test_stations_cure_it():
    found = verdict_of(tables(0.1, True)).texts
    assert not weak(found)
    sigma = [next(s.sigma for s in tables(0.1, stations).significance if s.parameter == "c_mm") for stations in (0, 1)]
    assert sigma[0] > 50 * sigma[1]


def test_stations_that_are_too_weak_do_not_cure_it():
    """It is rho and sigma that decide, not whether stations exist; the cure is not the one for a block without any."""
    found = weak(verdict_of(tables(0.1, 50.0)).texts)
    assert found[0].startswith("c of camera one")
    assert "stations of sigma 50 m hardly separate them. Add better camera stations" in found[0]


def test_a_stopped_solution_reports_weak_directions():
    """Where it was before the optimum the observations fit already, and the same direction is weak."""
    optimum = tables(0.1, False).adjusted
    stopped = dataclasses.replace(optimum, converged=np.array(False))
    first, *others = verdict_of(Tables(stopped)).findings
    assert "step limit" in first.text
    assert any("c of camera one with Z of all images: hardly separable" in f.text for f in others)
    assert {f.severity for f in (first, *others)} == {"error"}


def test_a_stopped_solution_without_fit_suggests_snooping():
    """Then no direction is weak for sure, and the errors are gross ones."""
    optimum = tables(0.1, True).adjusted
    far = jax.tree.map(lambda v: 100.0 * np.asarray(v), optimum.residuals)
    stopped = dataclasses.replace(optimum, converged=np.array(False), residuals=far)
    _, told = verdict_of(Tables(stopped)).findings
    assert told.code == "nothing_fits" and told.value > 90 and "--snoop" in told.hint


def test_relief_cures_it():
    assert not weak(verdict_of(tables(2.0, False)).texts)


@pytest.mark.slow
def test_a_fixed_c_is_not_reported():
    (only,) = weak(verdict_of(tables(0.1, False, ("xp_mm", "yp_mm"))).texts)
    assert "principal point" in only


@pytest.mark.parametrize("axes", [(2,), (0, 1)])
def test_stations_along_some_axes_cure_what_these_see(axes):
    """Heights tell c from Z; plane positions tell the principal point from X and Y."""
    made = tables(0.1, True).adjusted.block
    keep = np.isin(made.stations.axis, axes)
    part = dataclasses.replace(made, stations=made.stations.take(keep))
    found = weak(verdict_of(Tables(adjust(part))).texts)
    assert len(found) == 1
    assert ("c of camera" in found[0]) is (axes == (0, 1))
