"""Clouds larger than memory: whole informative cells are kept, with the same result."""

from collections.abc import Iterator

import numpy as np
import pytest

from jaxphoto import InputError
from jaxphoto.cloud import Cloud
from jaxphoto.lidar.correction import scanner_path
from jaxphoto.lidar.strip_planes import cells_of
from jaxphoto.procedures.lidar import adjust_strips, kept_returns
from tests.procedures.strips import PRIORS, SETTINGS, fitted, flown

MOST = 60_000


def parts(size: int = 40_000) -> Iterator[Cloud]:
    cloud = flown().cloud
    for first in range(0, len(cloud), size):
        yield cloud.take(np.arange(first, min(first + size, len(cloud))))


def test_a_small_cloud_is_kept_whole():
    cloud = flown().cloud
    kept = kept_returns(parts, SETTINGS, most=len(cloud))
    np.testing.assert_array_equal(kept.xyz, cloud.xyz)
    np.testing.assert_array_equal(kept.time, cloud.time)
    assert kept.strips == cloud.strips


@pytest.fixture(scope="module")
def kept() -> Cloud:
    return kept_returns(parts, SETTINGS, scanner_path(flown().trajectory), most=MOST)


def test_whole_cells_are_kept_as_many_as_there_is_room_for(kept):
    cloud = flown().cloud
    assert len(cloud) > 3 * MOST
    ends = 2 * len(cloud.strips)
    assert 0.6 * MOST < len(kept) <= MOST + ends
    for k in range(len(cloud.strips)):
        every, some = (c.xyz[c.strip == k] for c in (cloud, kept))
        cells, number = np.unique(cells_of(every, SETTINGS), return_counts=True)
        there, of_these = np.unique(cells_of(some, SETTINGS), return_counts=True)
        short = number[np.searchsorted(cells, there)] - of_these
        # But for the first and the last return, which may be the only ones of their cells.
        assert (short > 0).sum() <= 2 and (short >= 0).all()
        time = cloud.time[cloud.strip == k]
        assert {time.min(), time.max()} <= set(kept.time[kept.strip == k].tolist())


def test_what_is_found_is_what_all_returns_say(kept):
    flight = flown()
    found, asked = adjust_strips(kept, flight.trajectory, SETTINGS, PRIORS), fitted()
    assert found.converged and float(found.adjusted.sigma0) == pytest.approx(1.0, abs=0.1)
    labels = found.adjusted.structure.labels
    assert labels == asked.adjusted.structure.labels
    own = np.array([label.startswith("scanner") for label in labels])
    value = [np.asarray(of.adjusted.values.shared)[of.adjusted.structure.free][own] for of in (found, asked)]
    off = value[0] - value[1]
    sigma, of_all = (np.asarray(of.covariance.shared_sigma)[own] for of in (found, asked))
    # Fewer planes: a little worse, and not farther off than that allows.
    assert (sigma < 2.5 * of_all).all()
    assert (np.abs(off) < 3 * sigma).all()


def test_cells_about_tie_points_are_kept():
    cloud = flown().cloud
    places = cloud.xyz[np.random.default_rng(1).choice(len(cloud), 20, replace=False)]
    kept = kept_returns(parts, SETTINGS, places=lambda: places, most=MOST)
    about = np.abs(cloud.xyz[:, None, :2] - places[:, :2]).max(axis=2).min(axis=1) < SETTINGS.cell_m / 2
    assert about.sum() > 100
    assert np.isin(cloud.time[about], kept.time).all()
    # More than there is room for: half of it is left to planes.
    every = cloud.xyz[::5]
    assert len(kept_returns(parts, SETTINGS, places=lambda: every, most=MOST)) <= MOST + 2 * len(cloud.strips)
    # Those about control stay, however many tie points there are.
    kept = kept_returns(parts, SETTINGS, places=lambda: every, surveyed=places, most=MOST)
    assert np.isin(cloud.time[about], kept.time).all() and len(kept) <= MOST + 2 * len(cloud.strips)


def test_looks_ahead_and_behind_are_told_apart():
    kept = kept_returns(parts, SETTINGS, scanner_path(flown().trajectory), "circle", most=MOST)
    assert 0 < len(kept) <= MOST + 4 * len(kept.strips)


def test_one_strip_is_refused_whatever_its_size():
    def alone() -> Iterator[Cloud]:
        for part in parts():
            yield Cloud(part.xyz)

    with pytest.raises(InputError, match="one strip"):
        adjust_strips(kept_returns(alone, SETTINGS, most=MOST), None, SETTINGS)
