"""A block made of arrays is the block of the same data, and what is missing or wrong in them is named."""

import numpy as np
import pandas as pd
import pytest

from jaxphoto import (
    FREE,
    Block,
    BlockError,
    Brown,
    InputError,
    InteriorOrientation,
    Outcome,
    Sensor,
    adjust,
    block_from_arrays,
)
from jaxphoto.block import Datum
from jaxphoto.camera import get_parameter, parameter_names
from tests.blocks import simulated
from tests.formulas import collinearity

XYZ, SIGMA_XYZ = ("X_m", "Y_m", "Z_m"), ("sigma_X_m", "sigma_Y_m", "sigma_Z_m")
POINTS = {"image": ["a", "b", "a", "b"], "point": [1, 1, 2, 2], "x_mm": [0.1, -4.2, 1, 2], "y_mm": [2, 2.1, 0, 0.5]}
KODAK = {"kodak": (Sensor(4500, 3000, 0.008), InteriorOrientation(35.0))}
STATION = {"image": ["a"], "X_m": [1.0], "Y_m": [2.0], "Z_m": [3.0], "sigma_m": [0.1]}


def test_the_example_of_the_module_runs():
    """The indented lines of its docstring, but for two images of one point they are a block."""
    lines = [line[4:] for line in block_from_arrays.__doc__.splitlines() if line.startswith("    ")]
    names = {"Block": Block, "Sensor": Sensor, "InteriorOrientation": InteriorOrientation}
    exec("\n".join(lines), names)
    assert repr(names["block"]) == "Block 'block': 2 images of 1 camera, 1 point in 2 image points"


def columns(names, values):
    return dict(zip(names, np.asarray(values).T, strict=True))


def scalars(who, rows):
    """A table of coordinates from `Rows`, NaN where there is none, with sigmas beside."""
    used, entry = np.unique(rows.who, return_inverse=True)
    value = np.full((2, len(used), 3), np.nan)
    value[:, entry, rows.axis] = rows.value, rows.sigma
    return {**columns(XYZ, value[0]), **columns(SIGMA_XYZ, value[1])}, [who[k] for k in used]


def assert_same_measurements(one, other):
    """As many, each of the same image and point with the same coordinates and sigmas, sorted by point and image."""
    measured = []
    for block in (one, other):
        rows = block.image_points
        named = zip(rows.image, rows.point, np.hstack([rows.xy, rows.sigma]).tolist(), strict=True)
        measured.append({(block.images[i], block.points[p]): values for i, p, values in named})
        assert len(measured[-1]) == len(rows.image)
    assert measured[0] == measured[1]
    assert (np.diff(one.image_points.point * len(one.images) + one.image_points.image) > 0).all()


def test_a_block_taken_apart_and_made_again_is_the_same():
    block = simulated("everything").block
    rows, start, mount = block.image_points, block.start.unknowns, block.image_mount[0]
    control, points = scalars(block.points, block.control)
    stations, images = scalars(block.images, block.stations)
    made = Block.of(
        pd.DataFrame(
            {
                "image": np.array(block.images)[rows.image],
                "point": np.array(block.points)[rows.point],
                **columns(("x_mm", "y_mm"), rows.xy),
                **columns(("sigma_x_mm", "sigma_y_mm"), rows.sigma),
            }
        ).sample(frac=1, random_state=3),
        {name: (block.sensors[name], start.interior[name]) for name in block.sensors},
        images={
            "image": block.images,
            "camera": block.image_camera,
            "strip": block.image_strip,
            "time_s": block.image_time,
            **columns(XYZ, start.exterior.position),
            **columns(("omega_deg", "phi_deg", "kappa_deg"), np.rad2deg(start.exterior.omega_phi_kappa)),
        },
        control={"point": points, **control},
        stations={"image": images, **stations},
        attitudes={
            "image": np.array(block.images)[block.attitudes.image],
            **columns(("roll_deg", "pitch_deg", "yaw_deg"), np.rad2deg(block.attitudes.roll_pitch_yaw)),
            **columns(("sigma_roll_deg", "sigma_pitch_deg", "sigma_yaw_deg"), np.rad2deg(block.attitudes.sigma)),
        },
        points={"point": block.points, **columns(XYZ, start.points)},
        mounts=dict.fromkeys(block.image_camera, start.mounts[mount]),
        free=["c_mm", "k1"],
    )
    assert made.images == block.images and made.image_camera == block.image_camera
    assert_same_measurements(made, block)
    named = [
        sorted(zip([b.points[p] for p in c.who], c.axis.tolist(), np.asarray(c.value).tolist(), strict=True))
        for b, c in ((made, made.control), (block, block.control))
    ]
    assert named[0] == named[1]
    np.testing.assert_allclose(made.stations.value, block.stations.value, rtol=0, atol=0)
    np.testing.assert_allclose(made.attitudes.roll_pitch_yaw, block.attitudes.roll_pitch_yaw, rtol=1e-15)
    for interior in made.priors.interior.values():
        free = [name for name in parameter_names(interior) if get_parameter(interior, name) == FREE]
        assert free == ["c_mm", "k1"]
    assert made.image_strip == block.image_strip and made.image_mount == block.image_camera
    np.testing.assert_allclose(
        made.start.unknowns.exterior.camera_from_object, start.exterior.camera_from_object, rtol=0, atol=1e-14
    )


def test_photographs_of_points_that_are_known_are_all_that_is_needed():
    """No start, no table but two: control in the object, its images, and a camera whose lens is wanted."""
    rng = np.random.default_rng(12)
    xyz = np.column_stack([rng.uniform(-300, 300, (24, 2)), rng.uniform(0, 120, 24)])
    rows = []
    for k, (x, y, angles) in enumerate([(-80, 0, (0.05, -0.1, 0)), (90, 10, (0, 0.1, 1.5)), (0, 60, (-0.1, 0, 3.0))]):
        for p, point in enumerate(xyz):
            rows.append((f"i{k}", f"p{p}", *collinearity(35.0, np.array(angles), np.array([x, y, 900.0]), point)))
    image, point, x, y = zip(*rows, strict=True)
    block = Block.of(
        {"image": image, "point": point, "x_mm": x, "y_mm": y},
        {"c": (Sensor(4500, 3000, 0.008), InteriorOrientation(34.8, distortion=Brown()))},
        sigma_mm=0.004,
        control={"point": [f"p{k}" for k in range(24)], **columns(XYZ, xyz), "sigma_m": [0.01] * 24},
        free=["c_mm"],
    )
    assert block.datum == Datum("control") and not block.start.image_known.any()
    adjusted = adjust(block)
    assert adjusted.outcome is Outcome.CONVERGED
    assert float(adjusted.unknowns.interior["c"].c) == pytest.approx(35.0, abs=1e-6)
    assert repr(block) == "Block 'block': 3 images of 1 camera, 24 points in 72 image points;\n  72 control coordinates"


def test_a_network_without_control_has_a_minimal_datum():
    assert Block.of(POINTS, KODAK, sigma_mm=0.004).datum.kind == "minimal"
    assert Block.of(POINTS, KODAK, sigma_mm=0.004, stations=STATION).datum.kind == "control"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"sigma_mm": None}, r"image_points: no standard deviation; give sigma_x_mm and sigma_y_mm, or sigma"),
        ({"sigma_mm": -1.0}, r"image_points, entry 0: the standard deviation sigma_x_mm is -1.0; it must be positive"),
        ({"cameras": {}}, r"cameras: empty"),
        ({"cameras": KODAK | {"d": KODAK["kodak"]}}, r"images: no column camera for 2 cameras; add it \(kodak, d\)"),
        ({"images": {"image": ["a"]}}, r"image_points, entry 1: image b is not listed under images"),
        (
            {"images": {"image": ["a", "b"], "camera": ["kodak", "x"]}},
            r"images, entry 1: unknown camera x \(kodak\)",
        ),
        ({"images": {"image": ["a", "b", "a"]}}, r"images, entry 2: image a is given twice"),
        (
            {"image_points": {k: v for k, v in POINTS.items() if k != "y_mm"}},
            r"image_points: the column y_mm is missing",
        ),
        ({"image_points": POINTS | {"x_mm": [1, 2, 3]}}, r"image_points: the columns differ in length"),
        ({"image_points": POINTS | {"x_mm": [1, 2, np.nan, 3]}}, r"image_points, entry 2: x_mm is nan; give a number"),
        ({"image_points": [{"image": "a"}]}, r"image_points: a list is no table"),
        ({"image_points": POINTS | {"point": [1, 1, None, 2]}}, r"image_points, entry 2: the point is empty"),
        (
            {
                "image_points": pd.DataFrame(POINTS)[["image", "point", "x_mm"]].to_dict("series")
                | {"y_mm": pd.Series(POINTS["y_mm"], [3, 2, 1, 0])}
            },
            r"image_points: image and y_mm are Series with different indexes",
        ),
        ({"stations": STATION | {"Z_m": [True]}}, r"stations: the column Z_m is bool; give real numbers"),
        (
            {"images": {"image": ["a", "b"], "time_s": pd.to_datetime(["2026-05-01", "2026-05-02"])}},
            "time_s is datetime",
        ),
        (
            {"image_points": POINTS | {"x_mm": [1, "2,5", 1, 3]}},
            r"image_points: x_mm, y_mm must have one number per entry",
        ),
        (
            {"image_points": POINTS | {"image": ["a"] * 4}},
            r"image_points, entry 1: point 1 is measured twice in image a",
        ),
        ({"image_points": {k: [] for k in POINTS}}, r"image_points: empty"),
        (
            {"control": {"point": ["9"], **columns(XYZ, [[1.0, 2.0, 3.0]])}},
            r"control, entry 0: point 9 is measured in no image",
        ),
        (
            {"control": {"point": ["1"], **columns(XYZ, [[1.0, 2.0, 3.0]])}},
            r"control: no standard deviation; give",
        ),
        (
            {"control": {"point": ["1"], **columns(XYZ, [[1.0, 2.0, 3.0]]), "role": ["chek"]}},
            r"control, entry 0: unknown role 'chek'",
        ),
        ({"stations": STATION | {"image": ["c"]}}, r"stations, entry 0: unknown image c"),
        ({"free": ["k9"]}, r"free: camera kodak has no parameter 'k9'; it has c_mm"),
    ],
)
def test_what_is_missing_or_wrong_is_named(changes, message):
    given = {"image_points": POINTS, "cameras": KODAK, "sigma_mm": 0.004} | changes
    with pytest.raises((InputError, BlockError), match=message):
        Block.of(given.pop("image_points"), given.pop("cameras"), **given)


def test_names_and_gaps_as_libraries_write_them():
    """HDF5 has bytes, pandas turns integers beside NaN into floats, netCDF masks what is missing."""
    known = {"point": np.array([1.0, 2.0]), **columns(XYZ, [[1.0, 2, 3], [4, 5, 6]]), "sigma_m": [0.1, 0.1]}
    known["Z_m"] = np.ma.masked_array([3.0, -9999.0], [False, True])
    given = POINTS | {"image": np.array([b"a", b"b ", b"a", b"b"])}
    block = Block.of(given, KODAK, sigma_mm=0.004, control=known)
    assert block.images == ("a", "b") and block.points == ("1", "2")
    assert list(zip(block.control.who, block.control.axis, block.control.value, strict=True)) == [
        (0, 0, 1.0), (0, 1, 2.0), (0, 2, 3.0), (1, 0, 4.0), (1, 1, 5.0),
    ]  # fmt: skip


def test_check_points_need_no_sigma_and_fixed_ones_are_fixed():
    known = {"point": ["1", "2"], **columns(XYZ, [[1.0, 2, 3], [4, 5, np.nan]]), "role": ["check", "fixed"]}
    block = Block.of(POINTS, KODAK, sigma_mm=0.004, control=known)
    assert (len(block.check.who), len(block.fixed.who), len(block.control.who)) == (3, 2, 0)
    assert list(block.start.point_known) == [False, False]
