"""From pixels to the calibrated camera: rendered photographs of a bumpy ground, whose truth is known.

Nothing is replaced: features, matches, orientation and adjustment are what the command line runs.
"""

import cv2
import numpy as np
import pandas as pd
import pytest
from scipy.stats import chi2

from jaxphoto import adjust, covariance
from jaxphoto.extras.photos.rendered_photographs import GROUND_M, SENSOR, ground_height, ground_texture
from jaxphoto.io import read_block
from jaxphoto.procedures.orientation.blocks import similarity_between
from jaxphoto.rotation import omega_phi_kappa_from_matrix
from tests.commands import run
from tests.formulas import camera_from_object
from tests.photos.ground import C_MM

pytestmark = pytest.mark.slow

K1 = 0.01
# Metres, and omega, phi, kappa in degrees; some are rolled by a quarter of a turn.
STATIONS = [
    ((-16, 0, 60), (0, -14, 0)),
    ((15, 3, 62), (3, 14, 85)),
    ((0, 16, 66), (-14, 0, 178)),
    ((2, -15, 58), (15, 2, -92)),
    ((-1, 1, 74), (1, -1, 40)),
    ((-12, -12, 63), (10, -12, 130)),
]


def rendered(ground, position, matrix, rng):
    """What the camera sees: the ray of each pixel, followed to the ground."""
    column, row = np.meshgrid(np.arange(SENSOR.width_px) + 0.5, np.arange(SENSOR.height_px) + 0.5)
    xy = SENSOR.mm_from_px(np.column_stack([column.ravel(), row.ravel()]))
    # Brown's model gives the ideal coordinates of measured ones in closed form.
    ideal = xy * (1 - K1 * np.sum(xy**2, axis=1, keepdims=True))
    ray = np.column_stack([ideal, np.full(len(xy), -C_MM)]) @ matrix
    x, y = np.zeros((2, len(xy)))
    for _ in range(25):
        far = (ground_height(x, y) - position[2]) / ray[:, 2]
        x, y = position[0] + far * ray[:, 0], position[1] + far * ray[:, 1]
    assert np.abs(position[2] + far * ray[:, 2] - ground_height(x, y)).max() < 1e-3
    middle = len(ground) / 2 - 0.5
    there = np.stack([middle + x / GROUND_M, middle - y / GROUND_M]).reshape(2, *column.shape).astype(np.float32)
    assert there.min() > 0 and there.max() < len(ground) - 1
    view = cv2.remap(ground, *there, cv2.INTER_CUBIC) + 2.0 * rng.normal(size=column.shape)
    return np.clip(np.round(view), 0, 255).astype(np.uint8)


@pytest.fixture(scope="module")
def photographed(tmp_path_factory):
    """The files, and the truth of their stations and rotations."""
    folder, rng = tmp_path_factory.mktemp("ground"), np.random.default_rng(2)
    ground = ground_texture(rng, 2600).astype(np.float32)
    positions = np.array([at for at, _ in STATIONS], float)
    matrices = np.stack([camera_from_object(*np.deg2rad(angles)) for _, angles in STATIONS])
    paths = [folder / f"view{k}.png" for k in range(len(STATIONS))]
    for path, position, matrix in zip(paths, positions, matrices, strict=True):
        cv2.imwrite(str(path), rendered(ground, position, matrix, rng))
    return paths, positions, matrices


def test_pixels_become_the_true_camera_and_poses(photographed, tmp_path, monkeypatch, capsys):
    paths, positions, matrices = photographed
    block, results = tmp_path / "block", tmp_path / "results"
    start = ["--pixel-mm", SENSOR.pixel_mm, "--c-mm", 1.08 * C_MM]
    code, said, wrong = run(monkeypatch, capsys, "orient", *paths, "--out", block, *start)
    assert code == 0, wrong
    assert f"{len(paths)} of {len(paths)} images oriented" in said
    code, _, wrong = run(monkeypatch, capsys, "adjust", block, "--out", results)
    assert code == 0, wrong

    interior = pd.read_csv(results / "interior.csv").set_index("parameter")
    truth = {"c_mm": C_MM, "k1": K1}
    for name in interior.index[interior.sigma > 0]:
        off = interior.value[name] - truth.get(name, 0.0)
        assert abs(off) < 3 * interior.sigma[name], (name, off, interior.sigma[name])
    assert interior.sigma["c_mm"] < 0.01 * C_MM
    assert interior.sigma["k1"] < 0.1 * K1

    adjusted = adjust(read_block(block))
    order = [int(name.removeprefix("view")) for name in adjusted.block.images]
    # Of omega, phi, kappa, as the command has it: nothing is compiled anew.
    cov = covariance(adjusted)
    matrix = np.asarray(cov.matrix)[: 6 * len(order), : 6 * len(order)] * float(cov.variance_factor)
    matrix = matrix.reshape(len(order), 6, len(order), 6)
    check_stations(adjusted, matrix[:, :3, :, :3], positions[order])
    check_rotations(adjusted, matrix[:, 3:, :, 3:], matrices[order])


def check_stations(adjusted, matrix, truth):
    """Positions after a similarity onto the truth, by their covariance after it."""
    there, n = np.asarray(adjusted.unknowns.exterior.position), len(truth)
    s = similarity_between(truth, there)
    off = (there - (s.shift + s.scale * truth @ s.turn.T)).ravel()
    # What a shift, a turn and a scale do to the stations; the similarity takes it away.
    middle = there - there.mean(axis=0)
    turns = [np.cross(axis, middle).ravel() for axis in np.eye(3)]
    open_ = np.column_stack([*(np.tile(axis, n) for axis in np.eye(3)), *turns, middle.ravel()])
    left = np.eye(3 * n) - open_ @ np.linalg.pinv(open_)
    within(off, left @ matrix.reshape(3 * n, 3 * n) @ left.T, 3 * n - 7)


def check_rotations(adjusted, matrix, truth):
    """Rotations from the first image to the others, which no datum changes."""
    found = np.asarray(adjusted.unknowns.exterior.camera_from_object)
    for k in range(1, len(truth)):
        relative = found[k] @ found[0].T
        off = small_angles(relative @ (truth[k] @ truth[0].T).T)
        slope = np.concatenate([slope_of(found[k]), -relative @ slope_of(found[0])], axis=1)
        both = matrix[np.ix_([k, 0], range(3), [k, 0], range(3))].reshape(6, 6)
        within(off, slope @ both @ slope.T, 3)


def small_angles(matrix):
    """The turn of a matrix that is nearly the unit matrix."""
    return 0.5 * np.array([matrix[2, 1] - matrix[1, 2], matrix[0, 2] - matrix[2, 0], matrix[1, 0] - matrix[0, 1]])


def slope_of(matrix):
    """How the camera frame turns with omega, phi and kappa, by differences."""
    angles, step = np.asarray(omega_phi_kappa_from_matrix(matrix)), 1e-6
    turned = [[camera_from_object(*(angles + sign * step * axis)) for sign in (1, -1)] for axis in np.eye(3)]
    return np.stack([small_angles(one @ other.T) for one, other in turned], axis=1) / (2 * step)


def within(off, matrix, degrees):
    sigma = np.sqrt(np.diagonal(matrix))
    assert (np.abs(off) < 3 * sigma).all(), off / sigma
    assert off @ np.linalg.pinv(matrix, rcond=1e-9) @ off < chi2.ppf(0.999, degrees)
