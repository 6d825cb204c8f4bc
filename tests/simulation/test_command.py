"""`jaxphoto simulate`: files of the folder, and an adjustment that recovers the truth."""

import functools

import jax
import numpy as np
import pandas as pd
import pytest

import jaxphoto
from jaxphoto.block import Block
from jaxphoto.io import read_block, recipe_from, write_simulation
from jaxphoto.io.toml import toml_text
from jaxphoto.simulation import simulate
from tests.commands import run
from tests.simulation.small import RECIPES, changed, made

XYZ = ["X_m", "Y_m", "Z_m"]
ANGLES = ["omega_deg", "phi_deg", "kappa_deg"]


def assert_same(got: Block, want: Block) -> None:
    assert jax.tree.structure(got) == jax.tree.structure(want)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        if isinstance(b, np.ndarray | jax.Array):
            np.testing.assert_allclose(a, b, rtol=2e-15, atol=1e-14)
        else:
            assert a == b


@pytest.mark.parametrize("name", ["000", "003"])
def test_the_folder_reads_as_the_simulated_block(name, tmp_path, monkeypatch, capsys):
    recipe, out = RECIPES / f"{name}.toml", tmp_path / "block"
    code, said, errors = run(monkeypatch, capsys, "simulate", recipe, "--out", out, "--seed", 5)
    assert (code, errors) == (0, "")
    want = simulate(jaxphoto.io.read_recipe(recipe), 5)
    assert f"{len(want.block.images)} images" in said
    assert_same(read_block(out), want.block)
    np.testing.assert_array_equal(read_block(out).image_points.xy, want.block.image_points.xy)
    np.testing.assert_array_equal(read_block(out).stations.value, want.block.stations.value)

    read = functools.partial(pd.read_csv, dtype={"image": str, "point": str})
    truth = {path.stem: read(path) for path in (out / "truth").iterdir()}
    assert set(truth) == {"interior", "exterior", "object_points", "georeferencing"}
    np.testing.assert_array_equal(truth["exterior"][XYZ], want.truth.exterior.position)
    angles = np.rad2deg(np.asarray(want.truth.exterior.omega_phi_kappa))
    np.testing.assert_allclose(truth["exterior"][ANGLES], angles, atol=1e-12)
    np.testing.assert_array_equal(truth["object_points"][XYZ], want.truth.points)
    assert tuple(truth["object_points"]["point"]) == want.block.points
    interior = truth["interior"].set_index("parameter")["value"]
    (camera,) = want.truth.interior.values()
    assert (interior["c_mm"], interior["xp_mm"], interior["k1"]) == (camera.c, camera.xp, camera.distortion.k1)


@pytest.mark.parametrize(
    "changes",
    [
        {"mounts.default": {"time_offset": "free", "truth": {"time_offset_s": 0.05}}},
        {"strips.default": {"shift": "free", "truth": {"drift_sigma_m_per_s": 0.01}}},
        {"start.points_m": 1.0, "targets.0.role": "vertical", "sigmas.station_m": None, "noise.station_m": None},
    ],
)
def test_whatever_is_simulated_can_be_read(changes, tmp_path):
    simulation = made(changes)
    write_simulation(simulation, tmp_path / "block")
    assert_same(read_block(tmp_path / "block"), simulation.block)


def test_a_second_simulation_replaces_block_and_truth(tmp_path):
    out = tmp_path / "block"
    write_simulation(made({"truth.datum_offset_m": [1.0, 2.0, 3.0]}), out)
    (out / "note.txt").write_text("kept")
    write_simulation(made(seed=2), out)
    assert_same(read_block(out), made(seed=2).block)
    offsets = pd.read_csv(out / "truth" / "georeferencing.csv")
    assert offsets["value"].tolist() == [0.0, 0.0, 0.0]
    assert (out / "note.txt").read_text() == "kept"
    assert [p.name for p in tmp_path.iterdir()] == ["block"]


def test_mistakes_end_with_one_sentence_and_nothing_written(tmp_path, monkeypatch, capsys):
    recipe = tmp_path / "bad.toml"
    recipe.write_text((RECIPES / "000.toml").read_text().replace("= 60.0\nside", "= 160.0\nside"))
    code, said, errors = run(monkeypatch, capsys, "simulate", recipe, "--out", tmp_path / "block")
    assert (code, said) == (2, "")
    assert errors.startswith("jaxphoto: bad.toml, [flight] forward_overlap_percent: 160")
    assert [p.name for p in tmp_path.iterdir()] == ["bad.toml"]
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.txt").write_text("mine")
    code, _, errors = run(monkeypatch, capsys, "simulate", RECIPES / "001.toml", "--out", tmp_path / "full")
    assert code == 2
    assert "was not written by jaxphoto" in errors
    assert [p.name for p in (tmp_path / "full").iterdir()] == ["thesis.txt"]
    assert {p.name for p in tmp_path.iterdir()} == {"bad.toml", "full"}


@pytest.mark.slow
def test_an_adjustment_of_a_simulated_block_finds_the_truth(tmp_path):
    """Ties, control, stations and attitudes with noise; camera, boresight and the shifts of two strips are found."""
    free = dict.fromkeys(("c_mm", "xp_mm", "yp_mm", "k1", "k2"), "free")
    values = changed(
        {
            "cameras.kodak.unknowns": free,
            "mounts.default": {"boresight": "free", "truth": {"boresight_deg": [0.2, -0.1, 0.3]}},
            "strips.A": {"shift": "free", "truth": {"shift_m": [0.8, -0.6, 0.5]}},
            "noise": None,
        }
    )
    assert recipe_from(values).noise == recipe_from(values).stated
    # Through TOML as well: what a recipe says survives being written.
    recipe = tmp_path / "recipe.toml"
    strips, targets = values["flight"].pop("strips"), values.pop("targets")
    lists = {"flight.strips": strips, "targets": targets}
    text = toml_text(values) + "".join(
        f"\n[[{name}]]\n" + "".join(f"{k} = {v!r}\n".replace("'", '"') for k, v in table.items())
        for name, tables in lists.items()
        for table in tables
    )
    recipe.write_text(text)
    write_simulation(simulate(jaxphoto.io.read_recipe(recipe), 11), tmp_path / "block")
    adjusted = jaxphoto.adjust(read_block(tmp_path / "block"))
    assert adjusted.outcome is jaxphoto.Outcome.CONVERGED
    assert abs(float(adjusted.sigma0) - 1) < 4 / np.sqrt(2 * adjusted.redundancy)
    tables = jaxphoto.Tables(adjusted)
    read = lambda name: pd.read_csv(tmp_path / "block" / "truth" / f"{name}.csv", dtype={"point": str})  # noqa: E731

    interior = tables.interior.dropna().merge(read("interior"), on=["camera", "parameter"], suffixes=("", "_true"))
    georeferencing = tables.georeferencing.merge(read("georeferencing"), on="parameter", suffixes=("", "_true"))
    assert (len(interior), len(georeferencing)) == (5, 6)
    for found in (interior, georeferencing):
        assert (np.abs(found["value"] - found["value_true"]) / found["sigma"]).max() < 4
    for ours, columns in (("exterior", [*XYZ, *ANGLES]), ("object_points", XYZ)):
        key = "image" if ours == "exterior" else "point"
        both = getattr(tables, ours).merge(read(ours), on=key, suffixes=("", "_true"))
        off = np.stack([(both[c] - both[f"{c}_true"]) / both[f"sigma_{c}"] for c in columns])
        assert len(both) == off.shape[1] > 10
        assert 0.7 < off.std() < 1.3
        assert np.abs(off).max() < 5
