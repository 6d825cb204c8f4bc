"""An orientation that was kept: the same in every bit, taken up for the same photographs only."""

import dataclasses

import equinox as eqx
import numpy as np
import pytest

from jaxphoto.camera import Brown, InteriorOrientation
from jaxphoto.io import kept_orientation
from jaxphoto.io.kept_orientation import kept_orient
from jaxphoto.io.kept_pieces import KeptPieces
from tests.procedures.orientable import PIXEL, SENSOR, convergent, photographed

START = InteriorOrientation(8.6, 0.0, 0.0, Brown())


@pytest.fixture(scope="module")
def photographs():
    return photographed(convergent(n_images=5, n_points=150))


def given(photographs):
    sigmas = [np.full(len(xy), 0.3 * PIXEL) for xy in photographs.features]
    return photographs.names, SENSOR, START, photographs.features, photographs.matches, sigmas


def test_what_was_kept_is_taken_up_in_every_bit(photographs, tmp_path, monkeypatch):
    said = []
    orient = kept_orient(KeptPieces(tmp_path / "kept"))
    first = orient(*given(photographs), title="five", report=said.append)
    assert said

    def never(*args, **options):
        raise AssertionError("oriented again")

    monkeypatch.setattr(kept_orientation, "orient", never)
    again = orient(*given(photographs), title="five", report=said.append)
    assert bool(eqx.tree_equal(first.block, again.block))
    assert (first.report, first.sizes) == (again.report, again.sizes)
    assert (first.residuals_mm == again.residuals_mm).all()
    for other in (
        {"title": "six"},
        {"sensor": dataclasses.replace(SENSOR, pixel_mm=0.0050001)},
        {"interior": InteriorOrientation(8.6, 0.0, 0.0, Brown(k1=1e-9))},
        {"features": [xy + 1e-9 for xy in photographs.features]},
        {"matches": photographs.matches[:-1]},
    ):
        names = ("names", "sensor", "interior", "features", "matches", "sigmas_mm")
        changed = dict(zip(names, given(photographs), strict=True)) | {"title": "five"} | other
        with pytest.raises(AssertionError, match="oriented again"):
            orient(**changed, report=said.append)
