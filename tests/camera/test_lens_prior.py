"""Lens priors: the table is sound, makes find their class, and sigmas do at the edge what they say."""

import numpy as np
import pytest

from jaxphoto.camera import DISTORTIONS, Brown, InteriorOrientation, Sensor, set_parameter
from jaxphoto.camera.lens_prior import LensPrior, lens_prior, lens_priors, prior_sigmas
from jaxphoto.procedures.known_lens import KnownLens
from tests.blocks import simulated

SENSOR = Sensor(5472, 3648, 0.0024)
NOMINAL = InteriorOrientation(8.8, 0.0, 0.0, Brown())


def test_every_figure_has_a_source_and_a_width():
    for _, _, prior in lens_priors():
        assert len(prior.source) > 40 or prior.name == "cameras of unknown make"
        widths = (prior.c_percent, prior.point_percent, prior.radial_percent, prior.decentring_percent)
        assert all(0.1 <= w <= 30 for w in widths) and 10 <= prior.drift_ppm_per_K <= 200


@pytest.mark.parametrize(
    ("make", "model", "name"),
    [
        ("DJI", "FC6310R", "DJI FC6310"),
        ("DJI", "M3E", "DJI M3E"),
        ("DJI", "FC3582", "cameras built into drones"),
        ("Hasselblad", "L1D-20c", "cameras built into drones"),
        ("Canon", "Canon EOS 5D", "interchangeable"),
        ("Canon", "Canon PowerShot S110", "compact"),
        ("SONY", "ILCE-7RM4", "interchangeable"),
        ("SONY", "DSC-RX1", "compact"),
        ("NIKON CORPORATION", "NIKON D800", "interchangeable"),
        ("Somebody", "Else", "unknown"),
        (None, None, "unknown"),
    ],
)
def test_a_camera_finds_its_prior(make, model, name):
    assert name in lens_prior(make, model).name


def test_what_was_calibrated_lies_within_it():
    # DewarpData of a Phantom 4 RTK: c 3659.8 px where EXIF's 24 mm on film stand for 3647; k1 of OpenCV -0.27.
    sigma = prior_sigmas(lens_prior("DJI", "FC6310R"), NOMINAL, SENSOR)
    assert abs(3659.8 - 3647) / 3647 * 8.8 < 2 * sigma["c_mm"]
    assert 45.9 * SENSOR.pixel_mm < 2 * sigma["yp_mm"]
    assert 2 * sigma["k1"] > 0.27 / 8.8**2


def test_a_coefficient_of_one_sigma_moves_the_corner_by_the_percentage():
    prior = lens_prior("DJI", "FC6310R")
    sigma = prior_sigmas(prior, NOMINAL, SENSOR)
    corner = np.array([SENSOR.width_mm, SENSOR.height_mm]) / 2
    for name in ("k1", "k2", "k3"):
        moved = set_parameter(NOMINAL, name, sigma[name]).closed_form(corner) - corner
        assert np.hypot(*moved) / np.hypot(*corner) == pytest.approx(prior.radial_percent / 100)
    moved = set_parameter(NOMINAL, "p1", sigma["p1"]).closed_form(corner) - corner
    assert np.hypot(*moved) / np.hypot(*corner) <= 1.001 * prior.decentring_percent / 100
    wider = prior_sigmas(prior, NOMINAL, SENSOR, 0.012)["c_mm"]
    assert wider == pytest.approx(8.8 * np.hypot(0.006, 0.012))


@pytest.mark.slow
@pytest.mark.parametrize("name", list(DISTORTIONS))
def test_every_model_has_sigmas(name):
    interior = InteriorOrientation(8.8, 0.0, 0.0, DISTORTIONS[name].plain(SENSOR))
    sigma = prior_sigmas(lens_prior("DJI", "M3E"), interior, SENSOR)
    usual = interior.distortion.usual()
    assert all(0 < sigma[n] < np.inf for n in usual)


def test_the_drift_is_told_in_micrometres():
    """30 ppm a kelvin of 10 mm over 10 K are 3 um."""
    prior = LensPrior("lenses of a test", 1.0, 1.0, 1.0, 1.0, 30.0, True, "nobody")
    block = simulated("cross").block
    camera = next(iter(block.sensors))
    known = KnownLens(InteriorOrientation(10.0, 0.0, 0.0, Brown()), prior, 0.0)
    assert "changes by about 3 µm with 10 K" in known.sentences(block, camera)[2]
