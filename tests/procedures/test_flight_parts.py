"""Photographs with little overlap to the others are a part of their own."""

import numpy as np
import pytest

from jaxphoto.camera import InteriorOrientation
from jaxphoto.initial.matches import MatchedPart, PairMatches
from jaxphoto.procedures.flight import KnownOfFlight, calibrate_flight
from tests.procedures.orientable import PIXEL, SENSOR, Camera, aerial, photographed

pytest.importorskip("pycolmap", reason="pycolmap, which orients images, is not installed (extra photos)")

LENS = Camera(8.0, 0.04, -0.03, 1e-4, -1e-6)
NOISE_PX, FEW = 0.3, 20


def test_groups_hang_together_and_are_counted_anew():
    features = lambda n: np.column_stack([np.arange(n), np.arange(n)])  # noqa: E731
    pairs = [PairMatches(0, 3, features(4)), PairMatches(1, 4, features(5)), PairMatches(2, 4, features(6))]
    gross = np.array([[0, 3, 7], [1, 2, 8], [0, 1, 9]])
    part = MatchedPart(list("abcdef"), [np.full((9, 2), k) for k in range(6)], [np.zeros(9)] * 6, pairs, gross, 1.5)
    assert part.n_gross == 24
    three, two = part.groups()
    assert three.names == ["b", "c", "e"] and two.names == ["a", "d"]
    assert [(p.first, p.second, len(p.features)) for p in three.pairs] == [(0, 2, 5), (1, 2, 6)]
    assert three.gross.tolist() == [[0, 1, 8]] and two.gross.tolist() == [[0, 1, 7]]
    assert [xy[0, 0] for xy in three.xy_mm] == [1, 2, 4]
    assert [g.names for g in part.groups(3)] == [three.names]
    assert [(p.first, p.second) for p in part.among({"a", "c", "d"}).pairs] == [(0, 2)]


@pytest.mark.slow
def test_photographs_that_the_others_hardly_see_are_a_part_of_their_own():
    p = photographed(aerial(per_strip=6, seed=1), LENS, NOISE_PX, 0.1)
    own = {0, 1, 2}
    # One pair joins the two: its points are in no third photograph of the other side.
    matches = [m for m in p.matches if (m.first in own) == (m.second in own)]
    (bridge,) = [m for m in p.matches if (m.first, m.second) == (2, 3)]
    alone = ~np.isin(bridge.features[:, 1], np.concatenate([m.features[:, 0] for m in matches if m.first == 3]))
    matches.append(PairMatches(2, 3, bridge.features[alone][:FEW]))
    sigmas = [np.full(len(xy), NOISE_PX * PIXEL) for xy in p.features]
    part = MatchedPart(list(p.names), p.features, sigmas, matches, np.zeros((0, 3), int), 1.0)
    assert len(part.groups()) == 1
    found = calibrate_flight(part, SENSOR, InteriorOrientation(8.0), KnownOfFlight())
    assert [len(one.oriented.block.images) for one in found.parts] == [9, 3] and not found.left_out
    assert found.parts[1].oriented.block.images == ("p00", "p01", "p02")
