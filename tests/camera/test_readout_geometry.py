"""What tells a readout from the scale of y: crossing strips do, and nothing does beside an affinity."""

import numpy as np
import pytest

from jaxphoto import adjust, covariance
from tests.simulation.small import made

CAMERA = {"width_px": 5472, "height_px": 3648, "pixel_mm": 0.0024, "distortion": "brown", "interior": {"c_mm": 8.8}}
CHANGES = {
    "mounts": {"default": {"image_x": "right"}},
    "shutters": {"kodak": {"readout_ms": 20.0, "readout": "free", "truth": {"readout_ms": 30.0}}},
    "jitter": {"position_m": 1.0, "angle_deg": 1.0},
    "points": {"ties": 150, "min_images": 3},
    "targets": [],
    "sigmas": {"image_mm": 0.0012, "station_m": 2.0},
    "noise": {},
    "start": {"position_m": 0.5, "angle_deg": 0.3},
}


def sigma_of_readout(headings, affine: bool) -> float:
    unknowns = dict.fromkeys(("c_mm", "xp_mm", "yp_mm", "k1", *(("b1",) if affine else ())), "free")
    strips = [
        {"name": f"S{k}", "heading_deg": heading, "images": 4, "across_spacings": 0.5}
        for k, heading in enumerate(headings)
    ]
    flight = {
        "height_m": 100.0, "forward_overlap_percent": 75.0, "side_overlap_percent": 60.0, "speed_m_per_s": 10.0,
        "strips": strips,
    }  # fmt: skip
    cameras = {"kodak": CAMERA | {"unknowns": unknowns}}
    found = adjust(made(CHANGES | {"flight": flight, "cameras": cameras}).block)
    assert bool(found.converged)
    sigma = dict(zip(found.structure.labels, np.asarray(covariance(found).shared_sigma), strict=True))
    return sigma["shutters[kodak].readout_ms"]


@pytest.mark.slow
def test_crossing_strips_tell_it_and_an_affinity_hides_it():
    to_and_fro = sigma_of_readout((0.0, 180.0, 0.0, 180.0), affine=False)
    crossing = sigma_of_readout((0.0, 180.0, 90.0, 270.0), affine=False)
    hidden = sigma_of_readout((0.0, 180.0, 90.0, 270.0), affine=True)
    assert crossing < 0.3 * to_and_fro
    assert hidden > 5 * crossing
