"""Recipes in TOML: the twins of the papers, and messages for mistakes."""

import re
import tomllib

import numpy as np
import pytest

from jaxphoto.errors import InputError
from jaxphoto.io import read_recipe, recipe_from
from jaxphoto.simulation import simulate
from tests.simulation.small import RECIPES, changed


def twin(name: str):
    recipe = read_recipe(RECIPES / f"{name}.toml")
    return recipe, simulate(recipe, 7)


def counts(block) -> tuple[int, int, int, int]:
    """Images, points, control points and check points."""
    return len(block.images), len(block.points), len(set(block.control.who)), len(set(block.check.who))


def overlaps(recipe) -> list[float]:
    return [round(100 * (1 - s.base_m / s.footprint.along), 6) for s in recipe.plan.strips]


def test_twin_of_000():
    recipe, (block, truth, _) = twin("000")
    assert counts(block) == (31, 154 + 33, 13, 20)
    assert [s.images for s in recipe.plan.strips] == [8, 8, 8, 7]
    assert overlaps(recipe) == [60.0] * 4
    a, b, c, d = recipe.plan.strips
    # 50 % of the 24 mm side between the strips of a pair: 350.4 m; the base is 420.4 m.
    assert a.base_m == pytest.approx(420.4, abs=0.05)
    for one, other in ((a, b), (c, d)):
        apart = abs((one.exposures.mean(axis=0) - other.exposures.mean(axis=0)) @ one.axes[1])
        assert apart == pytest.approx(350.4, abs=0.05)
    assert [(s.heading_deg - 75) % 360 for s in (a, b, c, d)] == [0, 180, 90, 270]
    assert abs(truth.exterior.position[:, 2].mean() - 1000) < 15
    assert block.attitudes.image.size == 0


@pytest.mark.parametrize(
    "changes, control, axes",
    [
        ({"targets.0.role": "control", "targets.0.choice": None}, 33, 99),
        ({"targets.0.role": "vertical", "targets.0.choice": None}, 33, 33),
    ],
)
def test_second_and_third_experiment_of_000_are_changes_of_the_first(changes, control, axes):
    values = tomllib.loads((RECIPES / "000.toml").read_text())
    first, other = (simulate(recipe_from(v), 7) for v in (values, changed(changes, values)))
    assert (len(set(other.block.control.who)), len(other.block.control.who)) == (control, axes)
    np.testing.assert_array_equal(first.truth.points, other.truth.points)
    np.testing.assert_array_equal(first.block.image_points.xy, other.block.image_points.xy)


def test_fourth_experiment_and_systematic_errors_of_000():
    values = tomllib.loads((RECIPES / "000.toml").read_text())
    changes = {
        "flight.strips": values["flight"]["strips"][:2],
        "points.ties": 96,
        "targets": [{"count": 20, "role": "vertical"}],
        "noise": {"image_mm": 0.002, "target_mm": 0.001, "station_m": [0.4, 0.4, 0.15]}
        | {"control_m": [0.015, 0.015, 0.029]},
        "truth": {"datum_offset_m": [-0.131, 0.186, 0.0]},
    }
    values = changed(changes, values)
    block, _, offset = simulate(recipe_from(values), 7)
    assert counts(block) == (16, 116, 20, 0)
    np.testing.assert_array_equal(offset, [-0.131, 0.186, 0.0])


def test_twin_of_003():
    recipe, (block, truth, _) = twin("003")
    assert counts(block) == (4 * 10 + 2 * 10, 320, 20, 0)
    assert overlaps(recipe) == [60.0] * 6
    assert [s.name for s in recipe.plan.strips] == ["E1", "E2", "E3", "E4", "N", "S"]
    assert recipe.plan.strips[0].height_m == pytest.approx(1395.8, abs=0.05)
    assert recipe.plan.strips[0].footprint == pytest.approx((942.0, 1443.0))
    middle = np.array([s.exposures.mean(axis=0) for s in recipe.plan.strips])
    np.testing.assert_allclose(np.diff(middle[:4, 1]), -0.7 * 1443, rtol=1e-9)
    np.testing.assert_allclose(middle[4:], [[-1500, 0], [1500, 0]], atol=1e-9)
    np.testing.assert_allclose(np.rad2deg(truth.mounts["default"].boresight), [-0.14, -0.0805, -0.1868])
    assert not np.any(block.start.unknowns.mounts["default"].boresight)
    np.testing.assert_allclose(np.rad2deg(block.attitudes.sigma[0]), [0.005, 0.005, 0.008])


def test_twin_of_004():
    recipe, (block, _, _) = twin("004")
    assert counts(block) == (23, 153 + 47, 8, 39)
    assert [s.images for s in recipe.plan.strips] == [12, 11]
    assert len(block.image_points.point) == 835
    assert np.bincount(block.image_points.point).min() >= 2
    north, south = recipe.plan.strips
    assert (north.heading_deg, south.heading_deg) == (0.0, 180.0)
    np.testing.assert_allclose([north.exposures[:, 0], [*south.exposures[:, 0], 0]], 0, atol=1e-9)
    assert (block.stations.sigma == 0.01).all()
    assert recipe.noise.station_m == (0.05,) * 3


@pytest.mark.parametrize("n, targets", [(1, {"at": [[0.0, 0.0]]}), (38, {"count": 30})])
def test_layouts_of_004_are_changes_of_its_targets(n, targets):
    values = tomllib.loads((RECIPES / "004.toml").read_text())
    first, *rest = values["targets"]
    extra = [] if n == 1 else [first]
    values["targets"] = [*extra, {"role": "control", **targets}, *rest]
    assert len(set(simulate(recipe_from(values), 7).block.control.who)) == n


def test_twin_of_001():
    recipe, (block, _, _) = twin("001")
    assert counts(block) == (3, 90, 30, 0)
    assert overlaps(recipe) == [60.0]
    assert set(block.control.axis) == {2}


STRIP = {"name": "A", "heading_deg": 0.0, "images": 3}


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"flihgt": {}}, "flihgt: unknown key"),
        ({"flight.strips.1.speed": 60}, r"\[flight.strips, number 2\] speed: unknown key"),
        ({"flight.forward_overlap_percent": -5.0}, r"\[flight\] forward_overlap_percent: -5.0 is less than 0"),
        ({"flight.forward_overlap_percent": 100}, r"forward_overlap_percent: 100 is not below 100"),
        ({"flight.gsd_m": 0.1}, r"\[flight\] gsd_m: height_m gives the same; keep one"),
        ({"flight.base_m": 100.0}, "forward_overlap_percent: base_m gives the same"),
        ({"flight.height_m": None}, r"\[flight\]: the height is not given; add height_m or gsd_m"),
        ({"flight.side_overlap_percent": None}, "the spacing is not given; add spacing_m or side_overlap_percent"),
        ({"flight.height_m": -100}, "height_m: -100 is not positive"),
        ({"flight.strips": {"name": "A"}}, r"strips: .* is not a list; .* as \[\[flight.strips\]\]"),
        ({"flight.strips.0.images": None}, r"number 1\] images: the key is missing"),
        ({"flight.strips.0.images": 2.5}, "images: 2.5 is not a whole number"),
        ({"flight.strips.1.name": "A"}, r"number 2\] name: duplicate strip name A"),
        ({"flight.strips.1.name": "default"}, "cannot be called 'default'"),
        ({"flight.strips.0.heading_deg": 400}, "heading_deg: 400 exceeds the maximum 360"),
        ({"flight.strips": [STRIP | {"images": 1}]}, "1 images in total"),
        ({"flight.strips.0.camera": "leica"}, r"unknown camera leica; use one of kodak"),
        ({"cameras": None}, "no cameras"),
        ({"cameras.kodak.truth.k9": 1.0}, r"\[cameras.kodak.truth\] k9: unknown key; use c_mm"),
        ({"cameras.kodak.truth.c_mm": 3425}, "c_mm: 3425 mm is not a valid principal distance"),
        ({"mounts.default.image_x": "up"}, "image_x: 'up' is unknown; write forward"),
        ({"strips.Z.truth.shift_m": [0, 0, 0]}, r"\[strips\] Z: unknown key; use default, A, B, C"),
        ({"terrain.kind": "moon"}, r"\[terrain\] kind: 'moon' is unknown; write .flat"),
        ({"terrain.height_m": 3}, r"\[terrain\] height_m: unknown key"),
        ({"points.ties": 2, "targets": None}, "2 points in total"),
        ({"points.min_images": 1}, "min_images: 1 is less than 2"),
        ({"points.mean_rays": 1.5}, "mean_rays: 1.5 is less than min_images = 2"),
        ({"targets.0.role": "contrl"}, r"\[targets, number 1\] role: 'contrl' is unknown; write .control"),
        ({"targets.0.at_m": [[1.0, "x"]]}, "at_m: 'x' is not a finite number"),
        ({"targets.0.choice": {"role": "check", "outer": 3}}, r"\[targets, number 1.choice\] outer: unknown key"),
        ({"targets.0.choice": {"role": "check", "centre": 1}}, "centre: 1 is neither true nor false"),
        ({"sigmas.image_mm": 0.0}, "image_mm: 0.0 is not positive"),
        ({"sigmas.station_m": [0.1, 0.0, 0.1]}, "station_m: .* is not positive"),
        ({"sigmas.control_m": None, "noise.control_m": None}, "control_m: the key is missing, but the recipe has"),
        ({"sigmas.station_m": None}, r"\[noise\] station_m: this has no observation; add station_m under \[sigmas\]"),
        ({"start.angle_deg": "x"}, "angle_deg: 'x' is not a finite number"),
        ({"datum.kind": "free"}, r"\[datum\] kind: 'free' is unknown"),
    ],
)  # fmt: skip
def test_mistakes_are_named_with_a_remedy(changes, message):
    with pytest.raises(InputError, match=f"^small.toml.*{message}") as error:
        recipe_from(changed(changes), "small.toml")
    assert "\n" not in str(error.value)


def test_a_camera_that_does_not_fly_is_refused():
    values = changed({})
    values["cameras"]["spare"] = values["cameras"]["kodak"]
    for strip in values["flight"]["strips"]:
        strip["camera"] = "kodak"
    with pytest.raises(InputError, match=re.escape("[cameras] spare: no image uses this camera")):
        recipe_from(values)


def test_two_cameras_at_two_heights():
    values = changed({"flight.strips.0.camera": "kodak", "flight.strips.1.camera": "other", "targets": []})
    values["cameras"]["other"] = changed({"truth": {}, "interior.c_mm": 50.0}, values["cameras"]["kodak"])
    values["flight"]["strips"][2] |= {"camera": "other", "height_m": 1500.0}
    values["mounts"] = {"other": {"truth": {"lever_arm_m": [1.0, 2.0, 3.0]}}}
    block, truth, _ = simulate(recipe_from(values), 3)
    assert block.image_camera == ("kodak",) * 5 + ("other",) * 9
    assert block.image_mount == ("",) * 5 + ("other",) * 9
    off = np.asarray(block.stations.value).reshape(-1, 3) - truth.exterior.position
    np.testing.assert_allclose(np.linalg.norm(off, axis=1), [0] * 5 + [np.sqrt(14)] * 9, atol=1e-9)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(InputError, match=r"file not found: .*nothing\.toml"):
        read_recipe(tmp_path / "nothing.toml")
