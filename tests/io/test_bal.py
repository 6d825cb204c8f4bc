"""Problems of "Bundle Adjustment in the Large": block, cost and refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxphoto.block import Datum
from jaxphoto.camera import BundlerRadial, get_parameter, parameter_names
from jaxphoto.collinearity import image_residual
from jaxphoto.errors import InputError
from jaxphoto.extras.formats import convert, read_source
from jaxphoto.io import read_block
from jaxphoto.unknowns import FREE
from tests.derivatives import compiled
from tests.formulas import turns

RNG = np.random.default_rng(16)
# Rotation vectors: none at all, omega-phi-kappa's phi = 90 degrees, more than half a turn.
VECTORS = np.array([[0.0, 0.0, 0.0], [0.0, np.pi / 2, 0.0], [2.5, -2.0, 1.0]])
ROTATIONS = turns(VECTORS)
POINTS = RNG.uniform(-1, 1, (5, 3))
TRANSLATIONS = np.array([[0.1, 0.2, -8.0], [-0.3, 0.0, -9.0], [0.2, -0.1, -7.0]])
INTERIOR = np.array([[500.0, -0.1, 0.02], [620.5, 0.05, 0.0], [800.0, 0.0, 0.0]])


def computed(camera, point):
    """BAL's own equations, in pixels."""
    seen = ROTATIONS[camera] @ POINTS[point] + TRANSLATIONS[camera]
    f, k1, k2 = INTERIOR[camera]
    p = -seen[:2] / seen[2]
    return f * (1 + k1 * (p @ p) + k2 * (p @ p) ** 2) * p


OBSERVED = [(camera, point) for point in range(5) for camera in range(3) if (camera, point) != (2, 4)]
NOISE = RNG.normal(size=(len(OBSERVED), 2))
XY = np.array([computed(camera, point) for camera, point in OBSERVED]) + NOISE


def lines_of():
    numbers = [*np.column_stack([VECTORS, TRANSLATIONS, INTERIOR]).ravel(), *POINTS.ravel()]
    return [
        f"3 5 {len(OBSERVED)}",
        *(f"{c} {p}     {x!r} {y!r}" for (c, p), (x, y) in zip(OBSERVED, XY.tolist(), strict=True)),
        *(repr(float(number)) for number in numbers),
    ]


@pytest.fixture
def write(tmp_path):
    """A function that writes the small problem; `change` spoils its list of lines."""

    def write(change=lambda lines: None):
        lines = lines_of()
        change(lines)
        path = tmp_path / "problem-3-5-pre.txt"
        path.write_text("\n".join(lines) + "\n")
        return path

    return write


@compiled
def residuals(interior, exterior, points, xy):
    return jax.vmap(image_residual)(interior, exterior, points, xy)


def weighted(block):
    rows, start = block.image_points, block.start.unknowns
    cameras = [start.interior[block.image_camera[i]] for i in rows.image]
    interior = jax.tree.map(lambda *v: jnp.stack([jnp.asarray(one, float) for one in v]), *cameras)
    exterior = jax.tree.map(lambda leaf: leaf[rows.image], start.exterior)
    return residuals(interior, exterior, start.points[rows.point], rows.xy) / np.asarray(rows.sigma)


def test_half_the_weighted_square_sum_is_the_cost_of_the_problem(write):
    block = read_source(write())
    v = weighted(block)
    np.testing.assert_allclose(v, NOISE, rtol=0, atol=1e-10)
    np.testing.assert_allclose(0.5 * np.sum(v**2), 0.5 * np.sum(NOISE**2), rtol=1e-11)


def test_a_problem_is_read_as_a_block(write):
    path = write()
    block = read_source(path)
    assert block.title == "problem-3-5-pre"
    assert block.images == block.image_camera == ("0", "1", "2")
    assert block.points == ("0", "1", "2", "3", "4")
    assert block.datum == Datum("inner", "points")
    assert block.start.image_known.all() and block.start.point_known.all()
    assert len(block.control.who) == len(block.fixed.who) == len(block.stations.who) == 0
    np.testing.assert_array_equal(block.start.unknowns.points, POINTS)
    for name, (f, k1, k2), sensor in zip("012", INTERIOR, block.sensors.values(), strict=True):
        interior, priors = (tree.interior[name] for tree in (block.start.unknowns, block.priors))
        assert isinstance(interior.distortion, BundlerRadial)
        values = [float(get_parameter(interior, n)) for n in parameter_names(interior)]
        np.testing.assert_allclose(values, [f / 1000, 0, 0, k1, k2], rtol=1e-15)
        assert {n for n in parameter_names(priors) if get_parameter(priors, n) == FREE} == {"c_mm", "k1", "k2"}
        assert sensor.pixel_mm == 0.001
        largest = np.abs([xy for (c, _), xy in zip(OBSERVED, XY, strict=True) if str(c) == name]).max(0)
        assert (np.array([sensor.width_px, sensor.height_px]) / 2 >= largest).all()
    exterior = block.start.unknowns.exterior
    np.testing.assert_allclose(exterior.camera_from_object, ROTATIONS, rtol=0, atol=2e-15)
    centres = [-r.T @ t for r, t in zip(ROTATIONS, TRANSLATIONS, strict=True)]
    np.testing.assert_allclose(exterior.position, centres, rtol=0, atol=1e-14)
    assert read_source(path.parent).points == block.points  # the folder holds one problem


def test_convert_and_back(write, tmp_path):
    block = convert(write(), tmp_path / "block", "bal")
    np.testing.assert_allclose(weighted(read_block(tmp_path / "block")), weighted(block), rtol=0, atol=1e-9)


def test_numbers_may_stand_several_in_a_line(write):
    def nine_and_three(lines):
        numbers = lines[15:]
        cameras = [" ".join(numbers[9 * i : 9 * i + 9]) for i in range(3)]
        lines[15:] = [*cameras, *(" ".join(numbers[27 + 3 * j : 30 + 3 * j]) for j in range(5))]

    block = read_source(write(nine_and_three))
    np.testing.assert_allclose(weighted(block), NOISE, rtol=0, atol=1e-10)


def fewer_rays(lines):
    """Point 4 is left with one image, point 3 with none."""
    gone = [f"{c} {p} " for c, p in ((0, 3), (1, 3), (2, 3), (1, 4))]
    lines[1:15] = [line for line in lines[1:15] if not line.startswith(tuple(gone))]
    lines[0] = "3 5 10"


def test_points_of_fewer_than_two_images_are_left_out(write):
    with pytest.warns(UserWarning, match=r"pre\.txt: .* 1 point\(s\) in fewer than two images"):
        block = read_source(write(fewer_rays))
    assert block.points == ("0", "1", "2")
    assert len(block.image_points.point) == 9


def replaced(row, new):
    """Row (from 1) becomes `new`; None deletes it."""

    def change(lines):
        lines[row - 1 : row] = [] if new is None else [new]

    return change


def shortened(lines):
    del lines[10:]


@pytest.mark.parametrize(
    ("change", "place"),
    [
        (replaced(1, "3 5"), "row 1"),
        (replaced(4, None), "row 15: .* is not 4 numbers"),
        (replaced(1, "3 5 13"), "46 numbers follow .* need 42 .* row 1"),
        (replaced(57, None), r"41 numbers follow .* need 42 \(9 per camera, 3 per point\)"),
        (shortened, "ends after 9 of 14 observations"),
        (replaced(3, "3 0 1.0 2.0"), "row 3: camera is not .* from 0 to 2"),
        (replaced(3, "1 -1 1.0 2.0"), "row 3: point is not .* from 0 to 4"),
        (replaced(20, "1.0e"), "row 20"),
        (replaced(31, "-500.0"), "f of camera 1 is -500"),
    ],
)
def test_a_bad_problem_is_refused(write, change, place):
    with pytest.raises(InputError, match=f"problem-3-5-pre.txt.* {place}"):
        read_source(write(change), "bal")


def test_an_image_of_two_points_is_skipped(write):
    def two_left(lines):
        lines[1:15] = [line for line in lines[1:15] if line[0] != "2" or line[2] in "01"]
        lines[0] = "3 5 12"

    with pytest.warns(UserWarning, match=r"pre\.txt: skipped 1 image\(s\) with fewer than 3 points: '2'"):
        assert read_source(write(two_left)).images == ("0", "1")


def test_a_folder_of_two_problems_is_refused(write):
    path = write()
    (path.parent / "other.txt").write_text(path.read_text())
    with pytest.raises(InputError, match=r"2 files of bal .*; give one"):
        read_source(path.parent, "bal")
