"""A blunder is named once, whichever of its coordinates shows it."""

import dataclasses

import numpy as np

from jaxphoto import Tables, adjust
from jaxphoto.report import residual_findings, verdict_of
from jaxphoto.statistics.reliability import LargestMdb
from tests.blocks import adjusted, simulated


def large(tables):
    return [f.subject for f in verdict_of(tables).findings if f.code == "blunder"]


def test_blunders_are_named_the_largest_first():
    assert not large(Tables(adjusted("cross")))
    block = simulated("cross").block
    rows, xy = block.image_points, np.array(block.image_points.xy)
    of_point = np.bincount(rows.point)
    # In points of many rays, else their other rays look as bad.
    first, second = (int(np.flatnonzero(rows.point == p)[2]) for p in np.argsort(-of_point, kind="stable")[:2])
    xy[first] += 0.08
    xy[second] -= [0.0, 0.05]
    spoilt = dataclasses.replace(block, image_points=dataclasses.replace(rows, xy=xy))
    found = large(Tables(adjust(spoilt)))
    names = [f"point {block.points[rows.point[k]]} in image {block.images[rows.image[k]]}" for k in (first, second)]
    assert found[0].startswith(names[0]) and found[1].startswith(names[1])


def test_what_nothing_checks_is_told_as_such(monkeypatch):
    hidden = [
        LargestMdb("stations", "station A in X", np.inf, 0.1, "m"),
        LargestMdb("stations", "station B in X", 2.0, 0.1, "m"),
    ]
    monkeypatch.setattr(residual_findings, "largest_mdbs", lambda adjusted, redundancy: hidden)
    *_, one, other = residual_findings.reliability_findings(Tables(adjusted("cross")))
    assert (one.code, one.subject, other.code, other.subject) == (
        "unchecked",
        "station A in X",
        "mdb",
        "station B in X",
    )
    assert other.value == 2.0 and "MDB 2 m (sigma 0.1 m" in other.text
