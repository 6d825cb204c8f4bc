"""Round trips of `write_block`; failed writes leave nothing."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from jaxphoto.block import Block
from jaxphoto.camera import Smac
from jaxphoto.errors import BlockError, InputError
from jaxphoto.io import read_block, write_block
from jaxphoto.observations import ControlCoordinates
from jaxphoto.unknowns import FIXED, FREE, Weighted

SMAC = ("block.toml", 'distortion = "brown"', 'distortion = "smac"\nsign = "add"')
PPS = ("block.toml", '"brown"', '"pps_radial"'), ("block.toml", "k1 = -1e-4", "k1 = -1e-4\npps_x = 0.25\npps_y = -0.5")
EBNER = ("block.toml", '"brown"', '"ebner"'), ("block.toml", "k1 = -1e-4", "b_mm = 1.5\nb3 = 1e-5")
BUNDLER = ("block.toml", '"brown"', '"bundler_radial"'), ("block.toml", "k1 = -1e-4", "k1 = -0.125\nk2 = 0.1")
R0 = ("block.toml", "k1 = -1e-4", "k1 = -1e-4\nr0_mm = 1.5\np3 = 1e-7")


def assert_same(got: Block, want: Block) -> None:
    """Equal in structure, ids and numbers; angles to rounding."""
    assert jax.tree.structure(got) == jax.tree.structure(want)
    for a, b in zip(jax.tree.leaves(got), jax.tree.leaves(want), strict=True):
        if isinstance(b, np.ndarray | jax.Array):
            np.testing.assert_allclose(a, b, rtol=1e-15, atol=1e-15)
        else:
            assert a == b


@pytest.mark.parametrize(
    "changes",
    [
        (),
        (SMAC, R0),
        PPS,
        BUNDLER,
        (*EBNER, ("block.toml", "k1 = { sigma = 2e-5 }", "b3 = { sigma = 2e-6 }")),
        (("block.toml", "{ sigma = 2e-5 }", "{ sigma = 2e-5, value = -3e-4 }"),),
        (("block.toml", '"small"', '"quotation \\" backslash \\\\ tab \\t Ω"'),),
        (("block.toml", 'drift = "free"', "drift = { sigma_m_per_s = [0.1, 0.2, 0.3] }\nshift_m = [1.0, 2.0, 3.0]"),),
        (("control_points.csv", "p2,,,4.0,,,,control", "p2,,,4.0,,,,control\np2,1.0,1.0,,,,,check"),),
        (("block.toml", 'over = ["p1", "p2", "p3"]\nscale = false', ""),),
        (("images.csv", "image,camera,strip,time_s", "image,camera,x,y"), ("block.toml", "[strips.default]", "")),
    ],
)
@pytest.mark.filterwarnings("ignore:.*not used:UserWarning")
def test_round_trip(write_folder, tmp_path, changes):
    if any(file == "images.csv" for file, _, _ in changes):
        changes = (changes[0], ("block.toml", '[strips.default]\nshift = "free"\ndrift = "free"\n', ""))
    block = read_block(write_folder(*changes))
    write_block(block, tmp_path / "copy")
    assert_same(read_block(tmp_path / "copy"), block)


@pytest.mark.parametrize("later", [0.0, 417_605.125])
def test_times_are_written_as_the_file_had_them(write_folder, tmp_path, later):
    """Also those of seconds of the week."""
    folder = write_folder()
    before = pd.read_csv(folder / "images.csv", dtype={"image": str})
    before["time_s"] += later
    before.to_csv(folder / "images.csv", index=False)
    block = read_block(folder)
    write_block(block, tmp_path / "copy")
    after = pd.read_csv(tmp_path / "copy" / "images.csv")
    assert after["time_s"].tolist() == before["time_s"].tolist()
    assert abs(float(np.mean(block.image_time))) < 1e-9


def test_round_trip_of_smac_keeps_what_is_static(write_folder, tmp_path):
    corrected = ("block.toml", 'distortion = "smac"', 'residuals = "model"\ndistortion = "smac"')
    write_block(read_block(write_folder(SMAC, R0, corrected)), tmp_path / "copy")
    interior = read_block(tmp_path / "copy").start.unknowns.interior["kodak"]
    assert interior.residuals == "model"
    distortion = interior.distortion
    assert isinstance(distortion, Smac)
    assert (distortion.sign, float(distortion.r0), float(distortion.p3)) == ("add", 1.5, 1e-7)


@given(
    values=st.lists(st.floats(-1e7, 1e7, allow_subnormal=False), min_size=3, max_size=3),
    sigma=st.floats(1e-12, 1e6),
    name=st.text(st.characters(blacklist_categories=("Cs", "Cc", "Zl", "Zp")), min_size=1).filter(
        lambda text: text.strip() == text and text not in ("p1", "p2", "p4")
    ),
)
@settings(max_examples=12, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_numbers_and_ids_round_trip_exactly(write_folder, tmp_path_factory, values, sigma, name):
    folder = tmp_path_factory.mktemp("any")
    source = folder.parent / "source"
    if not source.exists():
        write_folder().rename(source)
    block = read_block(source)
    points = tuple(name if point == "p3" else point for point in block.points)
    fixed = ControlCoordinates(block.fixed.who, block.fixed.axis, jnp.asarray(values), block.fixed.sigma)
    control = dataclasses.replace(block.control, sigma=jnp.full(4, sigma))
    block = dataclasses.replace(
        block, points=points, fixed=fixed, control=control, datum=dataclasses.replace(block.datum, over=(name,))
    )
    write_block(block, folder / "copy")
    got = read_block(folder / "copy")
    assert got.points == points
    assert got.datum.over == (name,)
    np.testing.assert_array_equal(got.fixed.value, values)
    np.testing.assert_array_equal(got.start.unknowns.points[2], values)
    np.testing.assert_array_equal(got.control.sigma, [sigma] * 4)


def test_an_existing_block_is_replaced_whole(write_folder, tmp_path):
    block, folder = read_block(write_folder()), tmp_path / "copy"
    write_block(block, folder)
    (folder / "notes.txt").write_text("mine")
    fewer = dataclasses.replace(block, distances=type(block.distances).none())
    write_block(fewer, folder)
    assert not (folder / "distances.csv").exists()
    assert (folder / "notes.txt").read_text() == "mine"
    assert_same(read_block(folder), fewer)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["block", "copy"]


def test_foreign_files_are_never_replaced(write_folder, tmp_path):
    """A block of the user's own, a table that was changed by hand, one that would be read with another block."""
    own = write_folder()
    block, before = read_block(own), {path: path.read_bytes() for path in own.iterdir()}
    with pytest.raises(InputError, match="block is not empty and was not written"):
        write_block(block, own)
    assert {path: path.read_bytes() for path in own.iterdir()} == before
    write_block(block, tmp_path / "changed")
    with (tmp_path / "changed" / "stations.csv").open("a") as file:
        file.write("# measured again\n")
    with pytest.raises(InputError, match=r"stations\.csv was changed since jaxphoto wrote it"):
        write_block(block, tmp_path / "changed")
    write_block(dataclasses.replace(block, distances=type(block.distances).none()), tmp_path / "added")
    (tmp_path / "added" / "distances.csv").write_bytes((own / "distances.csv").read_bytes())
    with pytest.raises(InputError, match=r"distances\.csv was not written by jaxphoto and would be lost"):
        write_block(block, tmp_path / "added")


def test_another_folder_is_left_alone(write_folder, tmp_path):
    block = read_block(write_folder())
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "1.jpg").write_text("")
    with pytest.raises(InputError, match=r"photos is not empty and was not written by jaxphoto"):
        write_block(block, tmp_path / "photos")
    assert [path.name for path in (tmp_path / "photos").iterdir()] == ["1.jpg"]
    with pytest.raises(InputError, match=r"1\.jpg is a file: give a folder"):
        write_block(block, tmp_path / "photos" / "1.jpg")


def test_an_empty_folder_and_missing_parents_are_fine(write_folder, tmp_path):
    block = read_block(write_folder())
    (tmp_path / "empty").mkdir()
    for folder in (tmp_path / "empty", tmp_path / "new" / "newer"):
        write_block(block, folder)
        assert_same(read_block(folder), block)


@pytest.mark.parametrize("prior", [FIXED, Weighted(0.0, 1.0)])
def test_priors_that_cannot_be_written_are_refused(write_folder, tmp_path, prior):
    block = read_block(write_folder())
    priors = eqx.tree_at(lambda u: u.points, block.priors, prior)
    with pytest.raises(BlockError, match="object points; reset"):
        write_block(dataclasses.replace(block, priors=priors), tmp_path / "copy")
    assert [path.name for path in tmp_path.iterdir()] == ["block"]


def test_mounts_without_a_camera_cannot_be_written(write_folder, tmp_path):
    block = read_block(write_folder())
    (mount,) = block.start.unknowns.mounts.values()
    start = dataclasses.replace(block.start.unknowns, mounts={"imu": mount})
    priors = dataclasses.replace(block.priors, mounts={"imu": next(iter(block.priors.mounts.values()))})
    renamed = dataclasses.replace(
        block,
        start=dataclasses.replace(block.start, unknowns=start),
        priors=priors,
        image_mount=("imu",) * len(block.images),
    )
    with pytest.raises(BlockError, match=r"has mount imu, but .*; name it \w+ or default"):
        write_block(renamed, tmp_path / "copy")
    some = dataclasses.replace(block, image_mount=("", *block.image_mount[1:]))
    with pytest.raises(BlockError, match="has no mount, but "):
        write_block(some, tmp_path / "copy")
    assert [path.name for path in tmp_path.iterdir()] == ["block"]


def test_a_failed_write_leaves_nothing(write_folder, tmp_path, monkeypatch):
    block = read_block(write_folder())

    def full(*_, **__):
        raise OSError("no space left on device")

    monkeypatch.setattr("pandas.DataFrame.to_csv", full)
    with pytest.raises(OSError, match="no space"):
        write_block(block, tmp_path / "copy")
    assert [path.name for path in tmp_path.iterdir()] == ["block"]


def test_free_stays_free(write_folder, tmp_path):
    write_block(read_block(write_folder()), tmp_path / "copy")
    priors = read_block(tmp_path / "copy").priors
    assert priors.interior["kodak"].c == FREE
    assert priors.interior["kodak"].yp == FIXED
    assert isinstance(priors.interior["kodak"].distortion.k1, Weighted)
