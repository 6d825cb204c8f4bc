"""Velocities of photographs from their neighbours in time: strips, gaps, whole seconds, refusals."""

import dataclasses

import numpy as np
import pytest
from PIL import Image

from jaxphoto import Tables, adjust
from jaxphoto.errors import InputError
from jaxphoto.io.photographs import photographs
from jaxphoto.procedures.flight import _rolling
from jaxphoto.procedures.rolling_shutter import velocities, with_rolling_shutter
from jaxphoto.unknowns import FREE
from tests.simulation.small import made

SPEED, STEP = 10.0, 2.0


def to_and_fro(rng, sigma=0.0, step=0.0):
    """Two strips of eight photographs, the second back, after a turn of 12 s."""
    along = SPEED * STEP * np.arange(8)
    there, back = np.column_stack([0 * along, along]), np.column_stack([0 * along + 60, along[::-1]])
    position = np.column_stack([np.vstack([there, back]), np.full(16, 100.0)])
    time = np.concatenate([STEP * np.arange(8), STEP * np.arange(8) + 26])
    true = np.repeat([[0, SPEED, 0], [0, -SPEED, 0.0]], 8, axis=0)
    noted = np.floor((time + rng.uniform(0, 1)) / step) * step if step else time
    return position + rng.normal(0, 1, (16, 3)) * sigma, noted, true


def test_without_noise_velocities_are_exact():
    position, time, true = to_and_fro(np.random.default_rng(0))
    found = velocities(position, time, np.zeros(16), 0.01)
    assert found.known.all()
    np.testing.assert_allclose(found.velocity, true, atol=1e-12)


def test_with_noise_they_are_within_their_sigmas():
    z = []
    for seed in range(40):
        position, time, true = to_and_fro(np.random.default_rng(seed), 0.1, 1.0)
        found = velocities(position, time, np.ones(16), 0.1)
        z.append((found.velocity - true) / found.sigma)
        assert (found.sigma[:, 1] < 1.5).all()
    assert np.abs(z).max() < 4 and np.mean(np.square(z)) < 1.3


def test_a_photograph_without_time_or_neighbours_is_not_known():
    position, time, _ = to_and_fro(np.random.default_rng(0))
    time[3], time[15] = np.nan, 500.0
    found = velocities(position, time, np.zeros(16), 0.01)
    assert not found.known[[3, 15]].any() and found.known.sum() == 14
    assert (found.velocity[15] == 0).all() and np.allclose(found.sigma[15], SPEED)


def test_a_block_gets_the_motions_of_its_simulation():
    block, truth, _ = made({"jitter": None, "shutters": {"kodak": {"truth": {"readout_ms": 30.0}}}})
    started = dataclasses.replace(block.start.unknowns, exterior=truth.exterior)
    late = {"A": 0.0, "B": 300.0, "C": 600.0}
    rows = zip(block.images, block.image_time, block.image_strip, strict=True)
    taken = {name: (float(t) + late[strip], 0.0) for name, t, strip in rows}
    given = with_rolling_shutter(block, taken, 0.1, known=started)
    for name, own in truth.more["motions"].items():
        np.testing.assert_allclose(given.start.unknowns.more["motions"][name].velocity, own.velocity, atol=1e-6)
    assert given.priors.more["shutters"]["kodak"].readout == FREE
    with pytest.raises(InputError, match="only 0 of 14 photographs have neighbours in time"):
        with_rolling_shutter(block, {}, 0.1)


def test_times_come_from_exif(tmp_path):
    for name, when, digits in (
        ("a", "2024:05:01 10:00:03", "25"),
        ("b", "2024:05:01 10:00:05", None),
        ("c", "no", None),
    ):
        exif = Image.Exif()
        exif.get_ifd(0x8769).update({0x9003: when} | ({0x9291: digits} if digits else {}))
        Image.new("RGB", (64, 48)).save(tmp_path / f"{name}.jpg", exif=exif)
    a, b, none = (p.taken for p in photographs(sorted(tmp_path.glob("*.jpg"))))
    assert none is None
    assert b.clock_s - a.clock_s == pytest.approx(1.75) and a.resolution_s == 0.01 and b.resolution_s == 1.0


@pytest.mark.slow
def test_a_flight_tells_the_readout_by_its_times():
    """Whole seconds, rates of turn that nobody tells, and a block that knew nothing of its shutter."""
    drone = {"width_px": 5472, "height_px": 3648, "pixel_mm": 0.0024, "distortion": "brown"}
    drone |= {"interior": {"c_mm": 8.8}, "unknowns": dict.fromkeys(("c_mm", "xp_mm", "yp_mm", "k1"), "free")}
    strips = [
        {"name": "S", "heading_deg": 0.0, "images": 6, "count": 3},
        {"name": "X", "heading_deg": 90.0, "images": 6, "count": 2},
    ]
    flight = {
        "height_m": 100.0, "forward_overlap_percent": 75.0, "side_overlap_percent": 60.0, "speed_m_per_s": 10.0,
        "strips": strips,
    }  # fmt: skip
    changes = {
        "cameras": {"kodak": drone}, "flight": flight, "mounts": {"default": {"image_x": "right"}},
        "shutters": {"kodak": {"truth": {"readout_ms": 30.0}}},
        "jitter": {"position_m": 0.5, "angle_deg": 1.0, "rate_deg_per_s": 0.3},
        "points": {"ties": 300, "min_images": 3}, "targets": [], "sigmas": {"image_mm": 0.0012, "station_m": 0.03},
        "noise": {}, "start": {"position_m": 0.5, "angle_deg": 0.3},
    }  # fmt: skip
    block = made(changes).block
    late = {name: 60.0 * k for k, name in enumerate(dict.fromkeys(block.image_strip))}
    rows = zip(block.images, block.image_time, block.image_strip, strict=True)
    taken = {name: (np.floor(float(t) + late[strip]), 1.0) for name, t, strip in rows}
    found, why = _rolling(adjust(block), taken, True)
    assert not why and 0.9 < float(found.sigma0) < 1.1
    table = Tables(found).georeferencing.set_index("parameter").loc["shutters[kodak].readout_ms"]
    assert abs(table["value"] - 30.0) < 3 * table["sigma"] < 6.0
    still, why = _rolling(found, taken, False)
    assert still is found and "need positions" in why
