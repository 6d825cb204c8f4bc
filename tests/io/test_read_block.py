"""Read good block folders in every permitted spelling, and the modes of georeferencing."""

import warnings

import equinox as eqx
import jax
import numpy as np
import pytest

from jaxphoto.block import Datum
from jaxphoto.camera import Brown14, Ebner, Gruen, Smac
from jaxphoto.errors import BlockError, InputError
from jaxphoto.io import read_block, write_block
from jaxphoto.unknowns import FIXED, FREE, Weighted
from jaxphoto.variants import direct, indirect, integrated
from tests.io.test_write_block import assert_same


def test_observations(write_folder):
    block = read_block(write_folder())

    assert block.title == "small"
    assert block.images == ("a", "b", "c")
    assert block.points == ("p1", "p2", "p3", "p4")
    rows = block.image_points
    np.testing.assert_array_equal(rows.point, [0, 0, 0, 1, 1, 1, 2, 2, 3, 3, 3])
    np.testing.assert_array_equal(rows.image, [0, 1, 2, 0, 1, 2, 0, 1, 0, 1, 2])
    np.testing.assert_array_equal(rows.xy[:3], [[0.1, 0.2], [0.15, 0.2], [0.2, 0.2]])
    np.testing.assert_array_equal(rows.sigma[:2], [[0.003, 0.002], [0.004, 0.004]])
    np.testing.assert_array_equal(block.control.who, [0, 0, 0, 1])
    np.testing.assert_array_equal(block.control.axis, [0, 1, 2, 2])
    np.testing.assert_array_equal(block.control.value, [1, 2, 3, 4])
    np.testing.assert_array_equal(block.control.sigma, [0.01, 0.01, 0.02, 0.03])
    np.testing.assert_array_equal(block.fixed.who, [2, 2, 2])
    np.testing.assert_array_equal(block.fixed.value, [5, 6, 7])
    np.testing.assert_array_equal(block.check.who, [3, 3, 3])
    np.testing.assert_array_equal(block.check.value, [8, 9, 10])
    np.testing.assert_array_equal(block.stations.value, [0, 0, 100, 10, 0, 100])
    np.testing.assert_array_equal(block.stations.sigma, [0.05, 0.05, 0.1, 0.1, 0.1, 0.1])
    np.testing.assert_allclose(block.attitudes.roll_pitch_yaw[0], np.deg2rad([1, -2, 45]))
    np.testing.assert_allclose(block.attitudes.sigma, np.deg2rad([[0.005, 0.005, 0.01], [0.01] * 3]))
    np.testing.assert_array_equal(block.distances.points, [[0, 1], [1, 2]])
    np.testing.assert_array_equal(block.distances.sigma, [0.001, 0.002])
    assert block.datum == Datum("inner", ("p1", "p2", "p3"), False)


def test_start_and_priors(write_folder):
    block = read_block(write_folder())
    start, priors = block.start.unknowns, block.priors

    np.testing.assert_array_equal(block.start.image_known, [True, True, False])
    np.testing.assert_allclose(np.rad2deg(start.exterior.omega_phi_kappa[0]), [0.5, -0.25, 90.0])
    np.testing.assert_array_equal(start.exterior.camera_from_object[2], np.eye(3))
    # Control goes before object_points.csv, axis by axis; a check point gives no start.
    np.testing.assert_array_equal(block.start.point_known, [True, True, True, False])
    np.testing.assert_array_equal(start.points, [[1, 2, 3], [2.5, 2.5, 4], [5, 6, 7], [0, 0, 0]])
    assert float(start.interior["kodak"].distortion.k1) == -1e-4
    assert priors.interior["kodak"].c == FREE
    assert priors.interior["kodak"].xp == FIXED
    weighted = priors.interior["kodak"].distortion.k1
    assert isinstance(weighted, Weighted)
    assert (float(weighted.value), float(weighted.sigma)) == (-1e-4, 2e-5)
    assert all(isinstance(leaf, jax.Array) and leaf.dtype == float for leaf in jax.tree.leaves(start))

    assert block.image_mount == ("default",) * 3
    np.testing.assert_array_equal(start.mounts["default"].lever_arm, [0.1, 0.2, -0.3])
    np.testing.assert_allclose(start.mounts["default"].boresight, np.deg2rad([0.5, 0, -0.25]))
    np.testing.assert_array_equal(priors.mounts["default"].lever_arm.sigma, [0.01] * 3)
    assert priors.mounts["default"].boresight == FREE
    assert block.image_strip == ("one", "one", "two")
    assert set(start.strips) == {"one", "two"}
    np.testing.assert_array_equal(block.image_time, [-1, 1, 0])
    assert priors.exterior.position == FREE
    assert priors.points == FREE


def test_angles_use_the_files_unit(write_folder):
    change = ("block.toml", 'boresight = "free"', "boresight = { sigma_deg = 0.1, value_deg = [1.0, 0.0, 0.0] }")
    prior = read_block(write_folder(change)).priors.mounts["default"].boresight
    np.testing.assert_allclose(prior.sigma, np.deg2rad([0.1] * 3))
    np.testing.assert_allclose(prior.value, np.deg2rad([1.0, 0, 0]))


def test_own_mount_and_strip_override_the_default(write_folder):
    block = read_block(
        write_folder(
            (
                "block.toml",
                "[datum]",
                '[mounts.kodak]\nlever_arm_m = [1.0, 1.0, 1.0]\n[strips.two]\ndrift = "fixed"\n[datum]',
            )
        )
    )
    assert block.image_mount == ("kodak",) * 3
    assert set(block.start.unknowns.mounts) == set(block.priors.mounts) == {"kodak"}
    assert block.priors.strips["one"].drift == FREE
    assert block.priors.strips["two"].drift == FIXED


def test_smallest_folder(write_folder):
    """Only what is needed: no mounts, strips, control, approximations."""
    optional = ("control_points", "stations", "attitudes", "object_points", "distances")
    block = read_block(
        write_folder(
            *((f"{name}.csv", "", None) for name in optional),
            ("images.csv", "", "image,camera\na,kodak\nb,kodak\nc,kodak\n"),
            ("block.toml", "[mounts.default]\nlever_arm_m = [0.1, 0.2, -0.3]\nlever_arm = { sigma_m = 0.01 }\n", ""),
            ("block.toml", 'boresight_deg = [0.5, 0.0, -0.25]\nboresight = "free"\n', ""),
            ("block.toml", '[strips.default]\nshift = "free"\ndrift = "free"\n', ""),
            ("block.toml", '[datum]\nkind = "inner"\nover = ["p1", "p2", "p3"]\nscale = false\n', ""),
        )
    )
    assert block.image_mount == block.image_strip == ("", "", "")
    assert block.start.unknowns.mounts == block.start.unknowns.strips == {}
    assert not block.start.image_known.any()
    assert not block.start.point_known.any()
    np.testing.assert_array_equal(block.image_time, [0, 0, 0])
    assert len(block.control.who) == len(block.stations.who) == len(block.distances.value) == 0
    assert block.datum == Datum()


def test_pixels(write_folder):
    """The centre of the upper left pixel is (0.5, 0.5); sigma_px and image_px are multiples of the pixel."""
    text = "image,point,column_px,row_px,sigma_px\n" + "".join(
        f"{image},{point},{200 + 10 * i},{150 - 20 * i},{'0.5' if i == 0 else ''}\n"
        for image in "abc"
        for i, point in enumerate(("p1", "p2", "p3", "p4"))
    )
    block = read_block(
        write_folder(("image_points.csv", "", text), ("block.toml", "image_mm = 0.004", "image_px = 0.3"))
    )
    np.testing.assert_allclose(block.image_points.xy[0], [0.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(block.image_points.xy[3], [0.1, 0.2])
    np.testing.assert_allclose(block.image_points.sigma[::3][:2], [[0.005, 0.005], [0.003, 0.003]])


@pytest.mark.parametrize("end", ["\n", "\r\n"])
@pytest.mark.parametrize("mark", ["", "\ufeff"])
def test_spellings_of_a_spreadsheet(write_folder, end, mark):
    """Semicolons or tabs with decimal commas, a byte order mark, Windows line ends, blanks, another order."""
    folder = write_folder()
    expected = read_block(folder)
    for name, between in (("image_points", " ; "), ("control_points", "\t")):
        path = folder / f"{name}.csv"
        lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
        cells = [line.split(",")[::-1] for line in lines]
        spelt = [between.join(cell.replace(".", ",") for cell in row) for row in cells]
        path.write_bytes((mark + end.join(["# comment, with a comma", "", *spelt, ""])).encode())
    block = read_block(folder)
    assert block.points == expected.points
    for got, want in zip(jax.tree.leaves(block), jax.tree.leaves(expected), strict=True):
        if isinstance(want, np.ndarray | jax.Array):
            np.testing.assert_array_equal(got, want)


def test_ids_are_text(write_folder):
    folder = write_folder()
    for path in folder.iterdir():
        path.write_text(
            path.read_text().replace("p1", "007").replace("p2", "1e3").replace("p3", "Ω, 3".replace(",", ""))
        )
    assert read_block(folder).points == ("007", "1e3", "Ω 3", "p4")


def test_an_image_may_be_in_no_strip(write_folder):
    block = read_block(write_folder(("images.csv", "c,kodak,two,20.0", "c,kodak,,")))
    assert block.image_strip == ("one", "one", "")
    assert set(block.start.unknowns.strips) == {"one"}
    np.testing.assert_array_equal(block.image_time, [-1, 1, 0])


def test_a_local_frame_may_be_called_enu(write_folder):
    assert read_block(write_folder(("block.toml", '"local"', '"enu"'))).title == "small"


def test_smac_has_a_balance_radius_and_a_sign(write_folder):
    block = read_block(
        write_folder(
            ("block.toml", 'distortion = "brown"', 'distortion = "smac"\nsign = "add"'),
            ("block.toml", "k1 = -1e-4", "k1 = -1e-4\nr0_mm = 1.5"),
        )
    )
    distortion = block.start.unknowns.interior["kodak"].distortion
    assert isinstance(distortion, Smac)
    assert (distortion.sign, float(distortion.r0)) == ("add", 1.5)
    assert block.priors.interior["kodak"].distortion.r0 == FIXED


@pytest.mark.parametrize(
    ("name", "model", "constant", "coefficient"),
    [("ebner", Ebner, "b", "b12"), ("gruen", Gruen, "b", "a55"), ("brown14", Brown14, "f", "a13")],
)
def test_additional_parameters_have_a_constant_that_is_given(write_folder, name, model, constant, coefficient):
    block = read_block(
        write_folder(
            ("block.toml", '"brown"', f'"{name}"'),
            ("block.toml", "k1 = -1e-4", f"{constant}_mm = 1.5\n{coefficient} = 1e-9"),
            ("block.toml", "k1 = { sigma = 2e-5 }", f'{coefficient} = "free"'),
        )
    )
    distortion, priors = (tree.interior["kodak"].distortion for tree in (block.start.unknowns, block.priors))
    assert type(distortion) is model
    assert (float(getattr(distortion, constant)), float(getattr(distortion, coefficient))) == (1.5, 1e-9)
    assert getattr(priors, constant) == FIXED
    assert [name for name in model.coefficients if getattr(priors, name) == FREE] == [coefficient]


IDLE = """\
[cameras.idle]
width_px = 400
height_px = 300
pixel_mm = 0.01
distortion = "brown"
interior.c_mm = 5.0
"""


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("stations.csv", "sigma_Z_m", "remark"), ("stations.csv", "remark")),
        (("object_points.csv", "p2,", "p9,"), ("object_points.csv", "p9")),
        (("control_points.csv", "p4,8.0,9.0,10.0", "p8,8.0,9.0,10.0"), ("control_points.csv", "p8")),
        (("images.csv", "0.5,-0.25,90.0", "0.5,,90.0"), ("images.csv, row 2", "all six")),
        (
            ("block.toml", "[mounts", IDLE + "[mounts"),
            ("block.toml", "idle"),
        ),
    ],
)  # fmt: skip
def test_unused_content_is_reported(write_folder, change, words):
    with pytest.warns(UserWarning, match="not.* used") as caught:
        block = read_block(write_folder(change))
    assert len(caught) == 1
    for word in words:
        assert word in str(caught[0].message)
    assert set(block.sensors) == {"kodak"}
    assert len(block.points) == 4


def test_valid_folder_gives_no_warning(write_folder):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        read_block(write_folder())


PLACED = ("images.csv", "c,kodak,two,20.0,,,,,,", "c,kodak,two,20.0,20.0,0.0,100.0,0.0,0.0,90.0")
MODES = {"direct": direct, "integrated": integrated, "indirect": indirect}


def mode(name):
    return "block.toml", "[datum]", f'[georeferencing]\nmode = "{name}"\n[datum]'


def read_quietly(folder, name):
    """Image c has no station: direct georeferencing holds what images.csv says, and says so."""
    if name != "direct":
        return read_block(folder)
    with pytest.warns(UserWarning, match=r"mode = .direct.: 1 image\(s\) have no station and attitude.*is fixed: c$"):
        return read_block(folder)


@pytest.mark.parametrize("name", MODES)
def test_the_mode_selects_the_variant_and_round_trips(write_folder, tmp_path, name):
    block = read_quietly(write_folder(PLACED, mode(name)), name)
    (tmp_path / "block").rename(tmp_path / "first")
    assert_same(block, MODES[name](read_block(write_folder(PLACED))))
    write_block(block, tmp_path / "copy")
    assert_same(read_block(tmp_path / "copy"), block)
    held = FIXED if name == "direct" else FREE
    assert (block.priors.exterior.position, block.priors.exterior.camera_from_object) == (held, held)
    assert ("direct" in (tmp_path / "copy" / "block.toml").read_text()) == (name == "direct")


def test_integrated_is_the_default(write_folder):
    assert len(read_block(write_folder()).stations.who) == 6


def test_unknown_modes_are_refused(write_folder):
    with pytest.raises(InputError, match=r"\[georeferencing\] mode: 'pure' is unknown; write .direct., .integrated."):
        read_block(write_folder(mode("pure")))


def test_direct_needs_an_orientation_of_every_image(write_folder):
    with pytest.raises(BlockError, match=r"image c has neither station and attitude nor .*\(1 such image\)"):
        read_block(write_folder(mode("direct")))


def test_fixed_images_with_sensors_cannot_be_written(write_folder, tmp_path):
    block = read_block(write_folder(PLACED))
    both = lambda b: (b.priors.exterior.position, b.priors.exterior.camera_from_object)  # noqa: E731
    for held in ((FIXED, FIXED), (FIXED, FREE)):
        with pytest.raises(BlockError, match=r"fix all of it by jaxphoto\.variants\.direct"):
            write_block(eqx.tree_at(both, block, held), tmp_path / "copy")
    assert not (tmp_path / "copy").exists()
