"""Oriented photographs in the frame of their recorded positions: the truth again, jumps named, too little refused."""

import dataclasses

import equinox as eqx
import numpy as np
import pytest

from jaxphoto import adjust
from jaxphoto.errors import InputError
from jaxphoto.georeferencing.gps import Gps
from jaxphoto.georeferencing.map_frame import MapFrame
from jaxphoto.procedures.georeference_photographs import SIGMA_M, georeference_photographs, utm_of
from jaxphoto.rotation import matrix_from_omega_phi_kappa
from tests.blocks import free_network, simulated

ORIGIN = (13.2, 55.7, 0.0)
TURN = np.asarray(matrix_from_omega_phi_kappa(np.array([0.4, -0.7, 2.1])))


def network():
    """A free network at its optimum in a frame and a scale of its own, and the truth."""
    truth = simulated("cross").truth
    block = free_network()
    unknowns = adjust(block, truth).unknowns
    away = lambda x: 0.01 * (np.asarray(x) - 300.0) @ TURN.T + 5.0  # noqa: E731
    matrices = np.asarray(unknowns.exterior.camera_from_object) @ TURN.T
    exterior = dataclasses.replace(
        unknowns.exterior, position=away(unknowns.exterior.position), camera_from_object=matrices
    )
    moved = dataclasses.replace(unknowns, exterior=exterior, points=away(unknowns.points))
    return eqx.tree_at(lambda b: b.start.unknowns, block, moved), truth


def recorded(positions, names, sigma=None):
    frame = MapFrame(utm_of(*ORIGIN[:2]), None, ORIGIN)
    utm = frame.map(np.asarray(positions, float))
    places = frame.place(utm)
    return {
        name: Gps(latitude, longitude, height, sigma)
        for name, (longitude, latitude, height) in zip(names, places, strict=True)
    }


def test_the_block_is_where_its_photographs_were_taken():
    block, truth = network()
    rng = np.random.default_rng(2)
    position = np.asarray(truth.exterior.position)
    found = georeference_photographs(block, recorded(position + rng.normal(0, 0.5, position.shape), block.images))
    assert found.block.frame.code == utm_of(*ORIGIN[:2]) == 32633 and found.used.all()
    assert np.std(found.offsets_m) < 1.0
    np.testing.assert_allclose(found.block.stations.sigma[:3], SIGMA_M)
    a = adjust(found.block)
    assert bool(a.converged)
    # In the frame of the truth, by way of the map.
    own = found.block.frame.map
    back = MapFrame(own.code, None, ORIGIN).local(own.map(np.asarray(a.unknowns.exterior.position)))
    assert np.abs((back - position).mean(axis=0)).max() < 1.0
    turned = np.asarray(a.unknowns.exterior.camera_from_object) @ np.swapaxes(truth.exterior.camera_from_object, 1, 2)
    assert np.degrees(np.arccos((np.trace(turned, axis1=1, axis2=2) - 1) / 2)).max() < 0.5


def test_positions_that_jump_are_named_and_left_out():
    block, truth = network()
    position = np.array(truth.exterior.position)
    wrong = [2, 7]
    position[wrong] += [[40.0, -30.0, 10.0], [0.0, 0.0, 60.0]]
    found = georeference_photographs(block, recorded(position, block.images, (0.02, 0.02, 0.04)))
    assert np.flatnonzero(~found.used).tolist() == wrong
    named = [s for s in found.sentences if "contradicts the others" in s]
    assert [block.images[k] in s for k, s in zip(wrong, named, strict=True)] == [True, True]
    assert set(np.asarray(found.block.stations.who)).isdisjoint(wrong)
    assert set(np.asarray(found.block.stations.sigma)) == {0.02, 0.04}


def test_too_few_positions_and_those_on_a_line_are_refused():
    block, truth = network()
    known = recorded(np.asarray(truth.exterior.position), block.images)
    with pytest.raises(InputError, match="2 of 10 photographs have a position"):
        georeference_photographs(block, dict(list(known.items())[:2]))
    line = recorded(np.linspace([0, 0, 900], [500, 0, 900], len(block.images)), block.images)
    with pytest.raises(InputError, match="lie on a line"):
        georeference_photographs(block, line)
    with pytest.raises(InputError, match="EPSG code 99 is unknown"):
        georeference_photographs(block, known, 99)
