"""Terrain, buildings and trees: heights, placement, visibility of points."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import poisson

from jaxphoto.errors import BlockError, InputError
from jaxphoto.io import recipe_from
from jaxphoto.simulation import ROLLING, Building, RandomWaves, Terrain, Tree
from jaxphoto.simulation.scene import entry_distances, intersect_crowns, roof_height, solids
from tests.simulation.small import changed, made

bounded = settings(max_examples=40, deadline=None, derandomize=True, database=None)
BUILDINGS = [{"roof": roof, "count": 40} for roof in ("flat", "gable", "monopitch")]
SCENE = {"terrain": {"kind": "flat", "buildings": BUILDINGS, "trees": [{"count": 150}]}, "points.ties": 100}


def at(building: Building, along, right) -> np.ndarray:
    """Places (east, north) by how far they lie along and to the right of the middle of a building."""
    h = np.deg2rad(building.heading_deg)
    east = np.sin(h) * np.asarray(along, float) + np.cos(h) * np.asarray(right, float)
    north = np.cos(h) * np.asarray(along, float) - np.sin(h) * np.asarray(right, float)
    return np.column_stack([east, north]) + building.centre_m


@pytest.mark.parametrize("heading", [0.0, 30.0, 217.0])
def test_roofs_have_the_heights_of_their_geometry(heading):
    terrain = Terrain(height_m=2.0)
    along, right = [0.0, 9.9, -9.9, 3.0, 0.0], [0.0, 3.0, -3.0, 4.9, -5.0 + 1e-9]
    rise = np.tan(np.deg2rad(30.0))
    expected = {
        "flat": np.full(5, 8.0),
        "gable": 8 + rise * (5 - np.abs(right)),
        "monopitch": 8 + rise * (5 + np.array(right)),
    }
    for roof, z in expected.items():
        building = Building((100.0, -50.0), heading, 20.0, 10.0, 8.0, roof, 0.0 if roof == "flat" else 30.0)
        built = dataclasses.replace(terrain, buildings=(building,))
        np.testing.assert_allclose(built.surface(at(building, along, right)), z, rtol=0, atol=1e-9)
        outside = at(building, [0.0, 10.01, -10.01, 0.0], [5.01, 0.0, 0.0, -5.01])
        np.testing.assert_array_equal(built.surface(outside), 2.0)
        np.testing.assert_array_equal(built.height(at(building, along, right)), 2.0)
        assert solids((building,)).top == pytest.approx(
            {"flat": 8, "gable": 8 + 5 * rise, "monopitch": 8 + 10 * rise}[roof]
        )
        # One metre from walls, inside and outside.
        open_ = built.open(at(building, [0.0, 8.9, 9.1, 10.9, 11.1, 0.0], [0.0, 0.0, 0.0, 0.0, 0.0, 5.5]))
        assert open_.tolist() == [True, True, False, False, True, False]


@bounded
@given(
    st.sampled_from(["flat", "gable", "monopitch"]), st.floats(0, 360), st.floats(4, 30), st.floats(4, 20),
    st.floats(0, 50), st.integers(0, 2**32),
)  # fmt: skip
def test_rays_enter_where_they_first_fall_below_the_surface(roof, heading, length, width, slope, seed):
    """Against marching: the first place, in steps of 2 cm, that lies inside the building."""
    rng = np.random.default_rng(seed)
    building = Building((3.0, -4.0), heading, length, width, 6.0, roof, 0.0 if roof == "flat" else slope)
    n, step = 60, 0.02
    origin = np.column_stack([rng.uniform(-30, 30, (n, 2)), rng.uniform(35, 40, n)])
    aim = np.column_stack([rng.uniform(-20, 20, (n, 2)) + building.centre_m, np.zeros(n)])
    direction = (aim - origin) / np.linalg.norm(aim - origin, axis=1, keepdims=True)
    by_roof, by_wall = entry_distances(solids((building,)), np.zeros(n, int), origin, direction)
    assert not (np.isfinite(by_roof) & np.isfinite(by_wall)).any()
    way = np.arange(0, 90, step)
    for k in range(n):
        xyz = origin[k] + way[:, None] * direction[k]
        xyz = xyz[xyz[:, 2] > 0]
        inside = np.flatnonzero(xyz[:, 2] <= roof_height((building,), xyz[:, :2]))
        met = min(by_roof[k], by_wall[k])
        length_to_ground = -origin[k, 2] / direction[k, 2]
        if len(inside):
            assert way[inside[0]] - step <= met <= way[inside[0]] + 1e-9
        elif met < length_to_ground:
            # A corner, passed between two steps.
            leaves = origin[k] + (met + step) * direction[k]
            assert leaves[2] > roof_height((building,), leaves[None, :2])[0] or leaves[2] < step
        if np.isfinite(met):
            just_within = origin[k] + (met + 1e-6) * direction[k]
            under = roof_height((building,), just_within[None, :2])[0] - just_within[2]
            assert (under < 1e-5) == np.isfinite(by_roof[k])


def test_what_is_placed_by_chance_stands_apart_and_within_its_ranges():
    simulation = made(SCENE)
    terrain = simulation.terrain
    assert [b.roof for b in terrain.buildings] == ["flat"] * 40 + ["gable"] * 40 + ["monopitch"] * 40
    assert len(terrain.trees) == 150
    for b in terrain.buildings:
        assert 10 <= b.length_m <= 30 and 8 <= b.width_m <= 15 and 3 <= b.eaves_m <= 9
        assert b.slope_deg == 0 if b.roof == "flat" else 20 <= b.slope_deg <= 40
    ground = recipe_from(changed(SCENE)).ground
    assert ground.contain(np.array([b.centre_m for b in terrain.buildings])).all()
    edge = np.linspace(-1, 1, 41)
    for k, b in enumerate(terrain.buildings):
        long, wide = b.length_m / 2, b.width_m / 2
        outline = [at(b, edge * long, s * wide + 0 * edge) for s in (-1, 1)]
        outline = np.vstack(outline + [at(b, s * long + 0 * edge, edge * wide) for s in (-1, 1)])
        others = terrain.buildings[:k] + terrain.buildings[k + 1 :]
        assert np.isneginf(roof_height(others, outline)).all()
        stems = np.array([t.at_m for t in terrain.trees])
        gap = np.hypot(*(outline[:, None] - stems).transpose(2, 0, 1)).min(axis=0)
        assert (gap > [t.radius_m for t in terrain.trees]).all()
    assert np.isneginf(roof_height(terrain.buildings, stems)).all()


def test_a_seed_of_the_terrain_keeps_what_stands_on_it():
    one, other = made(SCENE, seed=1), made(SCENE, seed=2)
    assert one.terrain == made(SCENE, seed=1).terrain
    assert one.terrain.buildings != other.terrain.buildings
    kept = [made(SCENE | {"terrain.seed": 5}, seed=seed).terrain for seed in (1, 2)]
    assert kept[0] == kept[1]


def test_given_buildings_and_trees_stand_where_they_are_asked_for():
    one = {"roof": "gable", "at_m": [[50.0, 20.0], [-80.0, 0.0]], "length_m": 12.0, "width_m": 8.0, "height_m": 4.0}
    group = one | {"slope_deg": 45.0, "heading_deg": 90.0}
    terrain = {"kind": "plane", "slope_east_percent": 2.0, "buildings": [group]}
    terrain["trees"] = [{"at_m": [[0.0, 0.0]], "height_m": 10.0, "radius_m": 3.0}]
    drawn = made({"terrain": terrain}).terrain
    assert drawn.buildings == (
        Building((50.0, 20.0), 90.0, 12.0, 8.0, 5.0, "gable", 45.0),
        Building((-80.0, 0.0), 90.0, 12.0, 8.0, 4.0 - 1.6, "gable", 45.0),
    )
    assert drawn.trees == (Tree((0.0, 0.0), 0.0, 10.0, 3.0),)
    np.testing.assert_allclose(
        drawn.surface(np.array([[50.0, 20.0], [55.0, 20.0], [50.0, 23.0]])), [9, 9, 6], atol=1e-9
    )


def test_points_lie_on_ground_and_roofs_in_the_open_and_are_seen():
    simulation = made(SCENE)
    terrain, points = simulation.terrain, np.asarray(simulation.truth.points)
    np.testing.assert_allclose(points[:, 2], terrain.surface(points[:, :2]), atol=1e-9)
    assert (points[80:100, 2] > 2.9).all()
    assert (points[:80, 2] == 0).mean() > 0.8
    for b in terrain.buildings:
        beyond = np.abs((points[:, :2] - b.centre_m) @ b.axes.T) - b.half
        inside = (beyond < 0).all(axis=1)
        assert (beyond[inside].max(axis=1, initial=-np.inf) < -1).all()
        assert (np.hypot(*np.maximum(beyond[~inside], 0).T) > 1).all()
    for tree in terrain.trees:
        assert (np.hypot(*(points[:, :2] - tree.at_m).T) > tree.radius_m + 1).all()
    assert (np.asarray(made(SCENE | {"points.on_roofs": 1.0}).truth.points)[:100, 2] > 2.9).all()


def test_buildings_hide_points_from_images():
    """A tower of 120 m beside a target: images on its other side do not see the target."""
    tower = {"at_m": [[0.0, 0.0]], "length_m": 60.0, "width_m": 60.0, "height_m": 120.0, "heading_deg": 0.0}
    target = {"targets": [{"role": "control", "at_m": [[38.0, 0.0]]}], "points.ties": 60, "jitter": {}}
    free = made(target | {"terrain": {"kind": "flat"}})
    hidden = made(target | {"terrain": {"kind": "flat", "buildings": [tower]}})
    sees = [set(s.block.image_points.image[s.block.image_points.point == 60].tolist()) for s in (free, hidden)]
    assert sees[1] < sees[0]
    position = np.asarray(free.truth.exterior.position)
    for image in sees[0]:
        # Where the ray passes X = 30, the wall on this side, and whether that is below its top and within its width.
        part = (30 - 38.0) / (position[image, 0] - 38.0)
        z, y = part * position[image, 2], part * position[image, 1]
        assert (image in sees[1]) == (not (0 < part < 1 and z < 120 and abs(y) < 30))


def test_pulses_pass_a_crown_as_poisson_says():
    """Straight down through the middle of a crown 14 m deep: returns within it, and what reaches the ground."""
    tree, n = Tree((0.0, 0.0), 0.0, 20.0, 4.0), 40_000
    origin, down = np.tile([0.0, 0.0, 500.0], (n, 1)), np.tile([0.0, 0.0, -1.0], (n, 1))
    leaves = intersect_crowns((tree,), origin, down, np.full(n, 500.0), np.random.default_rng(4))
    z = 500 - leaves.at
    assert z.min() >= 6 - 1e-9 and z.max() <= 20
    # Of k meetings (at most 3 count) a pulse survives all with 2^-k.
    chance = poisson.pmf([0, 1, 2], 14 / 2.5)
    on = chance @ [1, 0.5, 0.25] + (1 - chance.sum()) * 0.125
    assert abs((~leaves.stopped).mean() - on) < 4 * np.sqrt(on * (1 - on) / n)
    per_pulse = np.bincount(leaves.pulse, minlength=n)
    none = chance[0]
    assert abs((per_pulse == 0).mean() - none) < 4 * np.sqrt(none / n)
    # First returns fall off exponentially with depth.
    _, first = np.unique(leaves.pulse, return_index=True)
    depth = leaves.at[first] - 480
    expected = 1 - np.exp(-2.5 / 2.5)
    assert abs((depth < 2.5).sum() / n - expected) < 4 * np.sqrt(expected * (1 - expected) / n)
    beside = intersect_crowns(
        (tree,), origin + np.array([4.01, 0, 0]), down, np.full(n, 500.0), np.random.default_rng(4)
    )
    assert not len(beside.pulse) and not beside.stopped.any()


def test_no_room_is_said():
    with pytest.raises(BlockError, match="no room for 4000 buildings"):
        made({"terrain.buildings": [{"count": 4000, "length_m": 300.0, "width_m": 100.0}]})


@pytest.mark.parametrize(
    "changes, message",
    [
        ({"terrain.houses": []}, r"\[terrain\] houses: unknown key"),
        ({"terrain.buildings": {"count": 3}}, r"is not a list; .* as \[\[terrain.buildings"),
        ({"terrain.buildings": [{"roof": "dome"}]}, "roof: 'dome' is unknown; write .flat"),
        ({"terrain.buildings": [{"length_m": [20.0, 10.0]}]}, "is not a range; give one number, or .minimum, max"),
        ({"terrain.buildings": [{"width_m": 0.0}]}, "width_m: 0.0 is not positive"),
        ({"terrain.trees": [{"crown_m": 2.0}]}, r"\[terrain.trees, number 1\] crown_m: unknown key"),
        ({"terrain.trees": [{"at_m": [[1.0]]}]}, "has 1 entries; give 2"),
        ({"points.on_roofs": 20.0}, "on_roofs: 20.0 exceeds the maximum"),
    ],
)  # fmt: skip
def test_mistakes_are_named_with_a_remedy(changes, message):
    with pytest.raises(InputError, match=f"^small.toml.*{message}") as error:
        recipe_from(changed(changes), "small.toml")
    assert "\n" not in str(error.value)


XY = np.random.default_rng(8).uniform(-4000, 4000, (20000, 2))


def terrain(**section) -> Terrain:
    return recipe_from(changed({"terrain": section})).terrain


def test_rolling_country_is_the_formula_of_the_twins():
    expected = 14 * np.sin(XY[:, 0] / 420) + 10 * np.cos(XY[:, 1] / 310)
    np.testing.assert_allclose(ROLLING.height(XY), expected, atol=1e-9)
    rough = ROLLING.place(XY, np.random.default_rng(1))
    np.testing.assert_array_equal(rough[:, :2], XY)
    off = rough[:, 2] - expected
    assert -6 <= off.min() < -5.99 and 5.99 < off.max() <= 6
    assert abs(off.std() - 6 / np.sqrt(3)) < 0.05


def test_plane_and_waves_of_a_recipe():
    plane = terrain(kind="plane", height_m=50.0, slope_east_percent=2.0, slope_north_percent=-1.0)
    np.testing.assert_allclose(plane.height(XY), 50 + 0.02 * XY[:, 0] - 0.01 * XY[:, 1], atol=1e-9)
    wave = {"amplitude_m": 3.0, "length_m": 500.0, "heading_deg": 0.0, "phase_deg": 30.0}
    waves = terrain(kind="waves", waves=[wave, wave])
    np.testing.assert_allclose(waves.height(XY), 6 * np.sin(2 * np.pi * XY[:, 1] / 500 + np.pi / 6), atol=1e-9)
    assert not terrain(kind="flat").height(XY).any()


def test_random_waves_have_their_height_and_follow_their_seed():
    ground = terrain(kind="random", count=40, rms_m=25.0, length_m=300.0)
    assert ground.random == RandomWaves(40, 25.0, 300.0)
    one, other = (ground.drawn(np.random.default_rng(k)).height(XY) for k in (1, 2))
    assert abs(one.std() - 25) < 2.5
    assert np.abs(one - other).max() > 10
    kept = terrain(kind="random", count=40, rms_m=25.0, length_m=300.0, seed=4)
    one, other = (kept.drawn(np.random.default_rng(k)).height(XY) for k in (1, 2))
    np.testing.assert_array_equal(one, other)
