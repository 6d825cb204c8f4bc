"""An oriented block in a frame of its own whose control is known from files: surveyed points in UTM, and marks."""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import numpy as np

from jaxphoto.block import Block
from jaxphoto.collinearity import ExteriorOrientation
from jaxphoto.georeferencing.map_frame import MapFrame
from jaxphoto.procedures.control.marks import without_names
from jaxphoto.procedures.control.surveyed import GivenControl, Marks, SurveyedPoints
from jaxphoto.procedures.georeference_photographs import utm_of
from jaxphoto.rotation import matrix_from_omega_phi_kappa
from jaxphoto.unknowns import Unknowns
from jaxphoto.variants import without_observations
from tests.blocks import free_network, simulated

ORIGIN = (13.2, 55.7, 0.0)
CODE = utm_of(*ORIGIN[:2])
CONTROL, CHECK = (0, 3, 10, 16, 32, 34), (12, 21, 25)
SIGMA_M = 0.02
TURN = np.asarray(matrix_from_omega_phi_kappa(np.array([0.4, -0.7, 2.1])))


class Marked(NamedTuple):
    block: Block
    truth: Unknowns
    control: GivenControl
    true_xyz: np.ndarray
    """Of the surveyed points, in the frame at `ORIGIN`."""


def marked_block(seed: int = 3, xy_mm: np.ndarray | None = None) -> Marked:
    """The crossing strips of `tests.blocks`, some of whose points are surveyed and marked instead.

    `xy_mm` are other measurements of all image points of `free_network`.
    """
    truth, block, rng = simulated("cross").truth, free_network(), np.random.default_rng(seed)
    if xy_mm is not None:
        block = eqx.tree_at(lambda b: b.image_points.xy, block, xy_mm)
    which = np.array(CONTROL + CHECK)
    rows = block.image_points
    own = np.isin(rows.point, which)
    kept, points = without_observations(block, {"image_points": own})
    sensor = block.sensors["one"]
    marks = Marks(
        tuple(f"DCIM/{block.images[i]}.JPG" for i in rows.image[own]),
        tuple(f"G{p}" for p in rows.point[own]),
        sensor.px_from_mm(np.asarray(rows.xy)[own]),
        np.full(int(own.sum()), 0.5),
        tuple(f"marks.csv, row {k + 2}" for k in range(own.sum())),
    )
    true = np.asarray(truth.points)[which]
    surveyed = true + rng.normal(0, SIGMA_M, true.shape)
    # As an orientation leaves it: adjusted, in a frame and a scale of its own.
    away = lambda x: 0.01 * (np.asarray(x) - 300.0) @ TURN.T + 5.0  # noqa: E731
    matrices = np.asarray(truth.exterior.camera_from_object) @ TURN.T
    exterior = ExteriorOrientation(away(truth.exterior.position), matrices)
    start = dataclasses.replace(truth, exterior=exterior, points=away(truth.points)[points])
    kept = eqx.tree_at(lambda b: b.start.unknowns, kept, start)
    control = SurveyedPoints(
        "control.csv", tuple(f"G{p}" for p in which), MapFrame(CODE, None, ORIGIN).map(surveyed),
        np.full(true.shape, SIGMA_M), np.isin(which, CHECK),
        tuple(f"control.csv, row {k + 2}" for k in range(len(which))), f"EPSG:{CODE}",
    )  # fmt: skip
    return Marked(kept, truth, GivenControl(control, marks), true)


def surveyed_and_without(block: Block) -> tuple[GivenControl, Block]:
    """The control and check points of a block in a local system with their marks, as files give them, and the rest."""
    who = np.unique(np.concatenate([block.control.who, block.check.who]))
    xyz, sigma = np.full((len(who), 3), np.nan), np.full((len(who), 3), np.nan)
    for rows in (block.control, block.check):
        at = np.searchsorted(who, rows.who), np.asarray(rows.axis)
        xyz[at], sigma[at] = rows.value, np.where(np.asarray(rows.sigma) > 0, rows.sigma, np.nan)
    rows, sensor = block.image_points, block.sensors[block.image_camera[0]]
    own = np.isin(rows.point, who)
    ids, places = tuple(block.points[p] for p in who), ("",) * int(own.sum())
    marks = Marks(
        tuple(block.images[i] for i in rows.image[own]),
        tuple(block.points[p] for p in rows.point[own]),
        sensor.px_from_mm(np.asarray(rows.xy)[own]),
        np.asarray(rows.sigma)[own, 0] / sensor.pixel_mm,
        places,
    )
    points = SurveyedPoints("survey", ids, xyz, sigma, np.isin(who, block.check.who), ids, "local")
    return GivenControl(points, marks), without_names(block, ids)
