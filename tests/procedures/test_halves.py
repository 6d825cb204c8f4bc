"""Split-half validation: factors and bands confirmed by simulation, and the common covariance."""

import dataclasses
import json

import equinox as eqx
import jax
import numpy as np
import pandas as pd
import pytest

from jaxphoto import adjust, covariance, read_block
from jaxphoto.adjustment import common_sizes
from jaxphoto.camera import get_parameter, parameter_names
from jaxphoto.errors import InputError
from jaxphoto.io import write_block
from jaxphoto.io.camera_files import read_camera_file
from jaxphoto.procedures.compare import halved, halves
from jaxphoto.simulation import image_coordinates, remeasure
from jaxphoto.stability import Differences, bundle_offsets, concentration, error_band, image_grid, leading_unit, overlap
from jaxphoto.stability.band import square_radius
from jaxphoto.statistics import common_covariance
from jaxphoto.variants import some_images
from tests.blocks import FIELDS, FIVE, SENSOR, adjusted_example, example, simulated
from tests.commands import run

CELLS = image_grid(SENSOR, 7, 5)


def test_of_many_linear_calibrations_the_factor_scatters_as_stated_and_the_band_holds():
    """Errors of 30 units z_i twice as large as promised: F is 2 with its sigma, and 95 % of new errors are inside."""
    rng = np.random.default_rng(4)
    cells, p, units, cuts, true = 12, 3, 30, 64, 2.0
    jacobian = rng.normal(size=(2 * cells, p))
    root = rng.normal(size=(p, p))
    by_cell = jacobian.reshape(cells, 2, p) @ root
    whole = units * np.einsum("cip,cjp->cij", by_cell, by_cell)
    size = np.ones(units)
    factors, sigmas, inside, fresh = [], [], [], []
    for _ in range(400):
        first = np.argsort(rng.random((cuts + 40, units)), axis=1) < units // 2
        z = true * np.einsum("cip,up->uci", by_cell, rng.normal(size=(units, p)))
        offsets = 2 * np.einsum("ku,uci->kci", np.where(first, 1.0, -1.0), z)
        promised = np.broadcast_to(4 * whole, (cuts, *whole.shape))
        axes = concentration(jacobian, root @ root.T)
        band = error_band(Differences(offsets[:cuts], promised, axes, overlap(first[:cuts], size)), whole)
        factors.append(band.factor)
        sigmas.append(band.sigma_factor / band.factor)
        error = true * units**0.5 * by_cell @ rng.normal(size=p)
        inside.append((np.linalg.norm(error, axis=1) < band.calibration).mean())
        fresh.append((np.linalg.norm(offsets[cuts:], axis=2) < band.halves).mean())
    assert np.mean(np.square(factors)) == pytest.approx(true**2, rel=0.05)
    assert np.std(factors) / true == pytest.approx(np.mean(sigmas), rel=0.12)
    assert np.mean(inside) == pytest.approx(0.95, abs=0.02)
    assert np.mean(fresh) == pytest.approx(0.95, abs=0.01)


def test_the_band_of_differences_holds_95_percent_where_one_unit_leads_them_all():
    """Differences of one size and two signs: the radius that is right for normal ones holds 99 % of them."""
    rng = np.random.default_rng(6)
    cells, p, units, cuts = 12, 3, 30, 64
    by_cell = rng.normal(size=(cells, 2, p))
    one = np.einsum("cip,cjp->cij", by_cell, by_cell)
    promised, size = np.broadcast_to(one, (cuts, *one.shape)), np.ones(units)
    axes = concentration(by_cell.reshape(2 * cells, p), np.eye(p))
    fresh, normal = [], []
    for _ in range(200):
        first = np.argsort(rng.random((cuts + 40, units)), axis=1) < units // 2
        effects = np.einsum("cip,up->uci", by_cell, rng.normal(size=(units, p)))
        effects[0] *= 20
        offsets = np.einsum("ku,uci->kci", np.where(first, 1.0, -1.0), effects)
        band = error_band(Differences(offsets[:cuts], promised, axes, overlap(first[:cuts], size)), one)
        length = np.linalg.norm(offsets[cuts:], axis=2)
        fresh.append((length < band.halves).mean())
        normal.append((length < band.cell_factor * np.sqrt(square_radius(one, 1 / cuts))).mean())
    assert np.mean(fresh) == pytest.approx(0.95, abs=0.012)
    assert np.mean(normal) > 0.98


@pytest.fixture(scope="module")
def field():
    """Photographs of a field of exact points."""
    return FIELDS["field"](26)


def measured(field, seed, **lens):
    block, truth = field
    distortion = dataclasses.replace(truth.interior["one"].distortion, **lens)
    truth = eqx.tree_at(lambda t: t.interior["one"].distortion, truth, distortion)
    new = remeasure(eqx.tree_at(lambda b: b.start.unknowns, block, truth), truth, jax.random.key(seed))
    return jax.tree.map(lambda v: np.asarray(v) if isinstance(v, jax.Array) else v, new)


def test_common_covariance_of_halves_is_that_of_finite_differences():
    """Against central differences of both adjustments by every coordinate of control."""
    block, truth = simulated("cross")
    # Without residuals, which would add their curvature to the differences and nothing to the linear covariance.
    exact = image_coordinates(block, truth), truth.points[block.control.who, block.control.axis]
    block = eqx.tree_at(lambda b: (b.image_points.xy, b.control.value), block, tuple(map(np.asarray, exact)))
    parts = [some_images(block, np.arange(10) % 2 == k) for k in (0, 1)]
    both = [adjust(part, part.start.unknowns) for part in parts]
    found = common_covariance(*both, "one", FIVE)

    def moved(part, at, name, axis, step):
        c = part.control
        own = (np.array(part.points, object)[c.who] == name) & (c.axis == axis)
        there = dataclasses.replace(part, control=dataclasses.replace(c, value=np.asarray(c.value) + step * own))
        return np.array([get_parameter(adjust(there, at.unknowns).unknowns.interior["one"], n) for n in FIVE], float)

    names = [{(part.points[w], a) for w, a in zip(part.control.who, part.control.axis, strict=True)} for part in parts]
    expected, sigma = np.zeros((5, 5)), float(parts[0].control.sigma[0])
    for name, axis in sorted(names[0] & names[1]):
        changes = [
            moved(part, at, name, axis, sigma) - moved(part, at, name, axis, -sigma)
            for part, at in zip(parts, both, strict=True)
        ]
        expected += np.outer(*changes) / 4
    size = np.sqrt(np.outer(*2 * [np.abs(np.diag(expected))]))
    assert (np.diag(expected) != 0).all()
    assert np.abs((found - expected) / size).max() < 0.02


def test_halves_agree_within_their_covariance(field):
    found = halves(measured(field, 3), CELLS, n_cuts=12)
    assert len(found.cuts) == 12 and not found.failed
    null = found.band.sigma_factor / found.band.factor
    assert abs(found.band.factor - 1) < 3 * null
    first, second = found.cuts[0].cameras
    again = np.asarray(bundle_offsets(first, second, CELLS, "rot").measured) / SENSOR.pixel_mm
    np.testing.assert_allclose(found.cuts[0].offsets_px, again)


@pytest.mark.slow
def test_the_factor_is_one_without_model_error_and_the_band_covers_with_it(field):
    """Sixteen blocks; then as many of a lens whose decentring the model lacks, judged by cuts that made no band."""
    factors = [halves(measured(field, seed), CELLS, n_cuts=20, seed=seed).band for seed in range(16)]
    null = np.mean([band.sigma_factor / band.factor for band in factors])
    assert abs(np.mean([band.factor**2 for band in factors]) - 1) < 4 * 2 * null / 16**0.5
    inside = []
    for seed in range(16):
        block = measured(field, seed, p1=4e-5)
        band = halves(block, CELLS, n_cuts=20, seed=1).band
        fresh = halves(block, CELLS, n_cuts=20, seed=2).cuts
        inside += [(np.linalg.norm(cut.offsets_px, axis=1) < band.halves).mean() for cut in fresh]
    assert np.mean(inside) == pytest.approx(0.95, abs=0.03)


def test_the_command_writes_cells_and_cuts(field, tmp_path, monkeypatch, capsys):
    write_block(measured(field, 3), tmp_path / "block")
    out = tmp_path / "out"
    command = ("halves", tmp_path / "block", "--cuts", 3, "--grid", "7x5", "--out", out)
    code, text, _ = run(monkeypatch, capsys, *command)
    assert code == 0
    assert "standard deviations of camera one" in text
    cells, cuts = pd.read_csv(out / "cells.csv"), pd.read_csv(out / "cuts.csv")
    assert (len(cells), len(cuts)) == (35, 3)
    rms = np.sqrt((cells.halves_px**2).mean())
    assert rms == pytest.approx(np.sqrt((cuts.rms_px**2).mean()), rel=1e-6)
    factor = json.loads((out / "summary.json").read_text())["factor"]
    own = adjust(read_block(tmp_path / "block"))
    sigma = np.sqrt(np.diag(read_camera_file(out).covariance))
    expected = np.sqrt(np.diag(covariance(own).of_interior("one", parameter_names(own.unknowns.interior["one"]))))
    np.testing.assert_allclose(sigma, expected * max(factor, 1.0), rtol=1e-6)
    assert {path.name for path in out.iterdir()} >= {"report.html", "summary.json"}
    code, _, error = run(monkeypatch, capsys, *command, "--by", "strip")
    assert (code, "image i0 has no strip" in error) == (2, True)


def test_impossible_splits_are_refused(field):
    block, _ = simulated("strips")
    with pytest.raises(InputError, match="choose one of one"):
        halves(block, CELLS, camera="two")
    one = dataclasses.replace(block, image_strip=("a",) * len(block.images))
    with pytest.raises(InputError, match="all images of camera one are in one strip"):
        halves(one, CELLS, by="strip")


def test_a_dominating_unit_is_found():
    """One of forty photographs moves its half by ten times what all others do together."""
    rng = np.random.default_rng(5)
    first = rng.random((24, 40)) < 0.5
    effects = rng.normal(0, 0.1, (40, 6, 2))
    effects[17] = 5.0
    offsets = np.einsum("ku,ucx->kcx", np.where(first, 1.0, -1.0), effects)
    unit, share = leading_unit(first, offsets)
    assert unit == 17 and share > 0.9
    # Which half is called the first is nothing.
    turned = np.where(np.arange(24) % 2 == 0, 1.0, -1.0)
    again = leading_unit(first ^ (turned < 0)[:, None], offsets * turned[:, None, None])
    assert again == pytest.approx((unit, share))
    # Where all are alike, none leads.
    alike = np.einsum("ku,ucx->kcx", np.where(first, 1.0, -1.0), rng.normal(size=(40, 6, 2)))
    assert leading_unit(first, alike)[1] < 0.4


def test_an_image_without_points_in_a_half_is_skipped():
    """It says nothing of the camera: the half goes without it."""
    block = example()
    adjusted, rng = adjusted_example(), np.random.default_rng(0)
    masks = (rng.permutation(len(block.images)) < len(block.images) // 2 for _ in range(1000))

    def few(mask):
        part = some_images(block, mask)
        return np.bincount(part.image_points.image, minlength=len(part.images)).min() < 3

    first = next(mask for mask in masks if few(mask) and not few(~mask))
    cells = image_grid(block.sensors["kodak"], 7, 5)
    cut = halved(adjusted, first, "kodak", cells, "rot", common_sizes([block]))
    assert not cut.problem and cut.offsets_px.shape == (len(cells), 2)


def test_too_few_images_to_split_are_refused():
    block = example()
    block = some_images(block, np.isin(block.images, ["A3", "A4"]))
    with pytest.raises(InputError, match=r"no two halves .* compared: the images of a half have too few"):
        halves(block, image_grid(block.sensors["kodak"], 7, 5), n_cuts=1)
