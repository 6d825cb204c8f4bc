"""Simultaneous adjustment of camera, scanner and strips, and correction of the cloud."""

import dataclasses
import functools

import numpy as np
import pytest

from jaxphoto import FIXED, FREE, InputError, Weighted, covariance
from jaxphoto.georeferencing import Scanner
from jaxphoto.lidar import HeightSettings
from jaxphoto.lidar.correction import correct_cloud, correct_trajectory, scanner_path
from jaxphoto.procedures.lidar import Simultaneous, simultaneous
from jaxphoto.statistics import physical_residuals
from tests.procedures.lidar import misaligned

SETTINGS = HeightSettings(sigma_z_m=0.1, sigma_xy_m=0.3)
GROUND = 2


@functools.cache
def both() -> Simultaneous:
    flight = misaligned()
    # Strip 1 is known to be right; were all strips shifted, the principal distance would not know how high they are.
    shift = Weighted(np.zeros(3), np.full(3, 2.0))
    priors = Scanner(FREE, {"1": FIXED, "2": shift, "3": shift})
    return simultaneous(flight.block, flight.cloud, flight.trajectory, priors, settings=SETTINGS)


def scanner_vector(scanner: Scanner) -> np.ndarray:
    return np.concatenate([scanner.boresight, *scanner.shifts.values()])


def test_boresight_and_shifts_of_the_scanner_are_recovered():
    found, flight = both(), misaligned()
    known = covariance(found.adjusted)
    labels = found.adjusted.structure.labels
    sigma = np.array([s for label, s in zip(labels, known.shared_sigma, strict=True) if label.startswith("scanner")])
    free, truth = np.r_[:3, 6:12], scanner_vector(flight.truth.scanner)
    off = (scanner_vector(found.scanner) - truth)[free]
    assert found.converged
    assert (np.abs(off) < 3 * sigma).all()
    # The simulated ones are many sigma: not to find them would show.
    assert (np.abs(truth[free]) > 3 * sigma).sum() > 5


def test_the_camera_is_calibrated_at_once():
    found, truth = both(), misaligned().truth.interior["kodak"]
    a, known = found.adjusted, covariance(found.adjusted)
    own = slice(0, a.structure.n_interior)
    true = [truth.c, truth.xp, truth.yp, truth.distortion.k1, truth.distortion.k2]
    off = np.asarray(a.values.shared)[a.structure.free][own] - true
    assert (np.abs(off) < 3 * np.asarray(known.shared_sigma)[own]).all()


def test_points_lie_on_the_corrected_cloud():
    found = both()
    before, after = (np.sqrt(np.nanmean(v**2)) for v in (found.apart_before, found.apart))
    assert after < 0.5 * before
    assert found.rounds[-1].rmse_m == pytest.approx(after, rel=0.1)


def test_the_cloud_is_corrected():
    """Laser points of the ground lie on the true ground as far as the strips' heights are known, and did not before."""
    before, after = above_ground(misaligned().cloud), above_ground(both().cloud)
    known = covariance(both().adjusted)
    sigma = dict(zip(both().adjusted.structure.labels, known.shared_sigma, strict=True))
    for k, name in ((1, "2"), (2, "3")):
        assert abs(after[k]) < 3 * sigma[f"scanner[{name}].shift_Z_m"] < abs(before[k])


def above_ground(cloud) -> np.ndarray:
    """Mean height of the laser points of the ground above the true ground, by strip."""
    ground = np.flatnonzero(cloud.classification == GROUND)[::20]
    off = cloud.xyz[ground, 2] - misaligned().terrain.height(cloud.xyz[ground, :2])
    strip = cloud.strip[ground]
    return np.array([off[strip == k].mean() for k in range(len(cloud.strips))])


def test_cloud_and_trajectory_are_corrected_consistently():
    """A shift moves both; a boresight the cloud alone. The truth mends all of it."""
    flight = misaligned()
    mended = correct_cloud(flight.cloud, flight.truth.scanner, scanner_path(flight.trajectory))
    np.testing.assert_allclose(above_ground(mended), 0.0, atol=0.01)
    moved = correct_trajectory(flight.trajectory, flight.cloud, flight.truth.scanner)
    shift = np.asarray(flight.trajectory.position) - np.asarray(moved.position)
    time = np.asarray(flight.trajectory.time)
    for k, name in enumerate(flight.cloud.strips):
        flown = flight.cloud.time[flight.cloud.strip == k]
        during = (time >= flown.min()) & (time <= flown.max())
        np.testing.assert_allclose(
            shift[during], np.tile(flight.truth.scanner.shifts[name], (during.sum(), 1)), atol=1e-9
        )


def test_observations_are_linear_about_the_result():
    """What the block says of the surface at the result is what the corrected cloud says."""
    a = both().adjusted
    residuals, told = physical_residuals(a)["surfaces"], np.isfinite(both().apart)
    assert told.mean() > 0.95
    off = np.abs(residuals + both().apart)[told]
    # Some laser point may have become a neighbour, or ceased to be one, since the last look.
    assert np.mean(off < 0.01) > 0.9 and off.max() < 0.1


@pytest.mark.slow
def test_without_a_trajectory_only_shifts_are_found():
    flight = misaligned()
    found = simultaneous(flight.block, flight.cloud, settings=SETTINGS, max_rounds=2)
    assert np.all(np.asarray(found.scanner.boresight) == 0)
    assert found.trajectory is None
    assert all(prior == FIXED for prior in [found.adjusted.priors.scanner.boresight])


def test_a_boresight_needs_a_trajectory():
    flight = misaligned()
    priors = dataclasses.replace(both().adjusted.priors.scanner)
    with pytest.raises(InputError, match="needs its trajectory"):
        simultaneous(flight.block, flight.cloud, None, priors, settings=SETTINGS)


def test_priors_go_by_the_names_of_strips():
    flight = misaligned()
    with pytest.raises(InputError, match="priors for the strips 1, 2, north, but the cloud has 1, 2, 3"):
        simultaneous(flight.block, flight.cloud, None, Scanner(FIXED, dict.fromkeys(("1", "2", "north"), FREE)))
