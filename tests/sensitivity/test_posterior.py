"""The posterior: equals its Gaussian where the block is strong, and the integrated density where it is not."""

import dataclasses
import functools
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
import pytest

from jaxphoto import FIXED, InputError, adjust, covariance
from jaxphoto.camera import Brown, InteriorOrientation
from jaxphoto.observations import ControlCoordinates
from jaxphoto.report.draws import posterior_table
from jaxphoto.sensitivity.posterior import Posterior, posterior
from tests.blocks import Scene, Simulated, adjusted, bare, free, measured

OF_CROSS = ("interior[one].c_mm", "interior[one].xp_mm", "exterior[i3].Z", "exterior[i7].kappa", "points[p5].Z")


def standard_errors(p: Posterior) -> tuple[np.ndarray, np.ndarray]:
    """Standard errors of means and sigmas over the Laplace sigmas, for a normal posterior."""
    return 1 / np.sqrt(p.ess), 1 / np.sqrt(2 * p.ess)


def assert_gaussian(p: Posterior) -> None:
    sigma, (of_mean, of_sigma) = np.sqrt(np.diagonal(p.laplace)), standard_errors(p)
    assert (np.abs(p.mean - p.optimum) / sigma < 4.5 * of_mean).all()
    assert (np.abs(np.sqrt(np.diagonal(p.covariance)) / sigma - 1) < 4.5 * of_sigma).all()
    assert (p.rhat < 1.05).all()
    assert p.divergences.sum() == 0


@pytest.fixture(scope="module")
def of_cross() -> Posterior:
    return posterior(adjusted("cross"), OF_CROSS, draws=250, warmup=150, seed=3)


def test_strong_block_has_the_posterior_that_least_squares_reports(of_cross):
    assert of_cross.samples.shape == (2, 250, len(OF_CROSS))
    assert (of_cross.ess > 200).all()
    assert_gaussian(of_cross)
    pairs = of_cross.outside[np.triu_indices(len(OF_CROSS), 1)]
    assert (np.abs(pairs - 0.05) < 0.05).all()


def test_laplace_is_the_a_priori_covariance(of_cross):
    whole = covariance(adjusted("cross"))
    index = [whole.labels.index(name) for name in OF_CROSS[:-1]]
    np.testing.assert_allclose(of_cross.laplace[:-1, :-1], whole.matrix[np.ix_(index, index)], rtol=1e-8)
    np.testing.assert_allclose(of_cross.laplace[-1, -1], whole.points[5, 2, 2], rtol=1e-8)
    unknowns = adjusted("cross").unknowns
    assert of_cross.optimum[0] == pytest.approx(float(unknowns.interior["one"].c), abs=1e-12)
    assert of_cross.optimum[3] == pytest.approx(float(unknowns.exterior.omega_phi_kappa[7, 2]), abs=1e-12)


@pytest.mark.slow
def test_free_network_is_sampled_on_the_plane_of_its_constraints():
    a = adjusted("inner")
    names = ("interior[one].c_mm", "exterior[i2].X", "points[p4].Z")
    p = posterior(a, names, draws=150, warmup=150, seed=2)
    whole = covariance(a)
    index = [whole.labels.index(name) for name in names[:2]]
    np.testing.assert_allclose(p.laplace[:2, :2], whole.matrix[np.ix_(index, index)], rtol=1e-6)
    np.testing.assert_allclose(p.laplace[2, 2], whole.points[4, 2, 2], rtol=1e-6)
    assert_gaussian(p)


class TwoHeights(NamedTuple):
    """Two vertical images, one above the other, of one point with known X and Y: c and Z are unknown."""

    adjusted: object
    heights: np.ndarray
    place: np.ndarray
    xy: np.ndarray


SIGMA_MM = 0.1
PARAMETERS = ("interior[one].c_mm", "points[p0].Z")


@functools.cache
def two_heights() -> TwoHeights:
    place, heights = np.array([330.0, 210.0, 0.0]), np.array([1000.0, 1100.0])
    scene = Scene(np.array([[0.0, 0.0, h] for h in heights]), np.zeros((2, 3)), place[None])
    camera = InteriorOrientation(35.0, 0.0, 0.0, Brown())
    block, truth = bare(scene, {"one": camera}, ("one", "one"))
    rows = dataclasses.replace(block.image_points, sigma=np.full((2, 2), SIGMA_MM))
    reference = ControlCoordinates(np.zeros(2, int), np.arange(2), place[:2], np.zeros(2))
    block = free(dataclasses.replace(block, image_points=rows, fixed=reference), "one", ("c_mm",))
    where = lambda b: (b.priors.exterior.position, b.priors.exterior.camera_from_object)  # noqa: E731
    block = eqx.tree_at(where, block, (FIXED, FIXED))
    simulated = measured(Simulated(block, truth), 4)
    a = adjust(simulated.block, jax.tree.map(np.asarray, truth))
    return TwoHeights(a, heights, place, np.asarray(simulated.block.image_points.xy))


def integrated(case: TwoHeights) -> tuple[np.ndarray, ...]:
    """Mean, sigma and skewness of c and Z, by summing the density over a grid."""
    c, z = np.meshgrid(np.linspace(10.0, 110.0, 3001), np.linspace(-2500.0, 700.0, 3001), indexing="ij")
    square = np.zeros_like(c)
    for height, xy in zip(case.heights, case.xy, strict=True):
        for axis in range(2):
            square += ((xy[axis] - c * case.place[axis] / (height - z)) / SIGMA_MM) ** 2
    density = np.exp(-0.5 * (square - square.min()))
    density /= density.sum()
    edge = density[0].sum() + density[-1].sum() + density[:, 0].sum() + density[:, -1].sum()
    assert edge < 1e-7
    moments = []
    for v in (c, z):
        mean = (density * v).sum()
        sigma = np.sqrt((density * (v - mean) ** 2).sum())
        moments.append((mean, sigma, (density * (v - mean) ** 3).sum() / sigma**3))
    return tuple(np.array(moments).T)


@pytest.mark.slow
def test_curved_posterior_is_the_density_summed_over_a_grid():
    case = two_heights()
    p, again = (posterior(case.adjusted, PARAMETERS, draws=400, warmup=150, seed=1) for _ in range(2))
    np.testing.assert_array_equal(p.samples, again.samples)
    mean, sigma, skewness = integrated(case)
    laplace = np.sqrt(np.diagonal(p.laplace))
    # The posterior is clearly non-Gaussian: the mean of c differs from its optimum, and it is skewed.
    assert (np.abs(skewness) > 0.4).all()
    assert (np.abs(mean - p.optimum) > 0.15 * laplace).all()
    assert (np.abs(p.mean - mean) / sigma < 4 / np.sqrt(p.ess)).all()
    np.testing.assert_allclose(np.sqrt(np.diagonal(p.covariance)), sigma, rtol=0.15)
    np.testing.assert_allclose(p.skewness, skewness, atol=0.4)
    assert (p.rhat < 1.05).all()


@pytest.mark.parametrize(
    ("given", "sentence"),
    [
        (
            {"parameters": ["interior[one].c"]},
            "similar names are interior\\[one\\].c_mm",
        ),
        ({"parameters": ["interior[one].p1"]}, "interior\\[one\\].p1 is fixed"),
        ({"parameters": []}, "at least one parameter, each once; got none"),
        ({"parameters": [OF_CROSS[0]] * 2}, "each once"),
        ({"draws": 0}, "draws must be at least 4, got 0"),
        ({"warmup": 0}, "warmup must be at least 1, got 0"),
        ({"chains": -1}, "chains must be at least 1, got -1"),
    ],
)
def test_bad_questions_get_one_sentence(given, sentence):
    with pytest.raises(InputError, match=sentence):
        posterior(adjusted("cross"), **{"parameters": OF_CROSS, **given})


def test_an_adjustment_that_did_not_converge_is_not_sampled():
    block = adjusted("cross").block
    half_way = adjust(block, block.start.unknowns, max_steps=1)
    with pytest.raises(InputError, match="needs a converged adjustment"):
        posterior(half_way, OF_CROSS)


def test_fixed_coordinates_and_images_have_no_posterior():
    a = two_heights().adjusted
    for name in ("points[p0].X", "exterior[i0].omega"):
        with pytest.raises(InputError, match="is fixed"):
            posterior(a, [name])


def test_the_table_shows_both(of_cross):
    table = posterior_table(of_cross)
    assert list(table["parameter"]) == [
        "interior[one].c_mm",
        "interior[one].xp_mm",
        "exterior[i3].Z_m",
        "exterior[i7].kappa_deg",
        "points[p5].Z_m",
    ]
    assert table["optimum"][3] == pytest.approx(np.rad2deg(of_cross.optimum[3]))
    assert table["laplace_sigma"][0] == pytest.approx(np.sqrt(of_cross.laplace[0, 0]))
    inside = (table["posterior_2.5_percent"] < table["optimum"]) & (table["optimum"] < table["posterior_97.5_percent"])
    assert inside.all()
