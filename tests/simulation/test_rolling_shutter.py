"""A rolling shutter in a recipe: rows see where the camera is while they are exposed, and the block is told so."""

import numpy as np

from jaxphoto.camera import RowMotion
from jaxphoto.simulation import image_coordinates
from tests.camera.test_rolling_shutter import by_bisection
from tests.simulation.small import made

SHUTTER = {"shutters": {"kodak": {"readout_ms": 10.0, "readout": "free", "truth": {"readout_ms": 30.0}}}}


def test_rows_are_seen_at_their_true_time():
    still, rolling = made(), made(SHUTTER)
    block, truth = rolling.block, rolling.truth
    camera, rows = truth.interior["kodak"], block.image_points
    difference = np.asarray(rows.xy) - np.asarray(still.block.image_points.xy)
    # 60 m/s for 15 ms are 0.9 m or 0.03 mm on the ground 1000 m below; the turn adds to it.
    assert 0.02 < np.abs(difference).max() < 0.2
    for k in range(0, len(rows), 37):
        name = block.images[rows.image[k]]
        position, rotation = (
            np.asarray(v)[rows.image[k]] for v in (truth.exterior.position, truth.exterior.camera_from_object)
        )
        own = truth.more["motions"][name]
        motion = np.concatenate([own.velocity, own.rate])
        seen = by_bisection(camera, position, rotation, motion, 30.0, truth.points[rows.point[k]])
        np.testing.assert_allclose(rows.xy[k], seen, atol=1e-9)
    np.testing.assert_allclose(image_coordinates(block, truth), rows.xy, atol=1e-9)


def test_the_block_is_told_motions_with_the_error_that_it_states():
    told = {"velocity_m_per_s": 0.5, "rate_deg_per_s": 0.2}
    block, truth, _ = made({"shutters": {"default": SHUTTER["shutters"]["kodak"] | told}})
    assert float(block.start.unknowns.more["shutters"]["kodak"].readout) == 10.0
    assert float(truth.more["shutters"]["kodak"].readout) == 30.0
    start, true = (
        np.array([[*m.velocity, *np.degrees(m.rate)] for m in u.more["motions"].values()])
        for u in (block.start.unknowns, truth)
    )
    z = (start - true) / np.repeat([0.5, 0.2], 3)
    assert 0.7 < z.std() < 1.3
    # Forward is where the camera's x axis points.
    assert (true[:, 0] > 55).all()
    prior = block.priors.more["motions"][block.images[0]]
    assert np.allclose(prior.velocity.sigma, 0.5) and np.allclose(prior.rate.sigma, np.radians(0.2))


def test_a_block_need_not_know():
    rolling = made({"shutters": {"kodak": {"truth": {"readout_ms": 30.0}}}})
    assert not rolling.block.start.unknowns.more
    assert np.array_equal(rolling.block.image_points.xy, made(SHUTTER).block.image_points.xy)


def test_a_readout_adds_up_to_rows():
    rows = RowMotion(1e-3, 5.0, 0.0, 0.0)
    assert np.allclose(rows.at_row(-12.0, (0.0, 0.0, -100.0)), (-0.06, 0.0, -100.0))
