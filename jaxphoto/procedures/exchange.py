"""Exchange of observations between rows of a block."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Float

from jaxphoto.adjustment import Adjustment
from jaxphoto.arrays import to_numpy
from jaxphoto.block import Block
from jaxphoto.initial.rays import camera_rays, turn_to_object
from jaxphoto.procedures.robust import Masks
from jaxphoto.short_repr import pretty_repr


@pretty_repr
class Exchange(NamedTuple):
    """Rows of a group that exchange observed values and standard deviations."""

    group: str
    rows: tuple[tuple[int, ...], ...]
    """Two or more each: the first receives the observation of the second, and so on; the last that of the first."""
    words: str
    """Message such as "points 12 and 31 of image A2 had each other's name"."""
    back: dict[str, tuple[int, ...]]
    """Rows that are accepted again after the exchange, by group."""
    out: tuple[int, ...] = ()
    """Rows of the group that belong to none of them, and are removed."""

    @property
    def undone(self) -> "Exchange":
        """Return the exchange of nothing."""
        return self._replace(rows=tuple(rows[::-1] for rows in self.rows), back={}, out=())


def exchanged(block: Block, left: Masks, exchange: Exchange) -> tuple[Block, Masks]:
    """Exchange these rows, and accept rows again."""
    rows = block.named_observations[exchange.group]
    order = np.arange(len(rows))
    for own in exchange.rows:
        order[list(own)] = np.roll(own, -1)
    new, sigma = rows.with_observation(to_numpy(rows.observation)[order]), to_numpy(rows.sigmas)
    new = new.with_sigmas_times(sigma[order] / sigma)
    left = left | {group: _marked(left[group], back, False) for group, back in exchange.back.items()}
    left = left | {exchange.group: _marked(left[exchange.group], exchange.out, True)} if exchange.out else left
    return block.with_observations({exchange.group: new}), left


def with_what_rests_on_them(done: Sequence[Exchange], wrong: Sequence[bool]) -> list[Exchange]:
    """Return wrong exchanges, and later ones of the same rows."""
    found: list[Exchange] = []
    rows: set[tuple[str, int]] = set()
    for exchange, bad in zip(done, wrong, strict=True):
        own = {(exchange.group, row) for rows_ in exchange.rows for row in rows_}
        if bad or own & rows:
            found.append(exchange)
            rows |= own
    return found


def with_places(at: Adjustment, places: Mapping[int, Float[np.ndarray, "3"]]) -> Adjustment:
    """Return `at` with points at these places (m)."""
    points = np.array(to_numpy(at.unknowns.points))
    for point, place in places.items():
        points[point] = place
    return eqx.tree_at(lambda a: a.unknowns.points, at, points)


def rays_of(
    at: Adjustment,
) -> tuple[Float[np.ndarray, "rows 3"], Float[np.ndarray, "rows 3"], Float[np.ndarray, "rows"]]:
    """Return for each image point the origin (m) and direction of its ray in the object frame, and c (mm) of its
    camera.
    """
    block, exterior = at.block, at.unknowns.exterior
    p, measured = block.image_points, to_numpy(block.image_points.xy)
    camera, rays, c = np.array(block.image_camera, object)[p.image], np.zeros((len(p), 3)), np.ones(len(p))
    for name, interior in at.unknowns.interior.items():
        own = camera == name
        if own.any():
            rays[own], c[own] = camera_rays(interior, measured[own]), float(interior.c)
    return to_numpy(exterior.position)[p.image], turn_to_object(to_numpy(exterior.camera_from_object), p.image, rays), c


def _marked(left: np.ndarray, rows: tuple[int, ...], out: bool) -> np.ndarray:
    found = left.copy()
    found[list(rows)] = out
    return found
