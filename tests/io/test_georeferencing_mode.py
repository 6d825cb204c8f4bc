"""`[georeferencing] mode` of block.toml: read, and written back."""

import equinox as eqx
import pytest

from jaxphoto.errors import BlockError, InputError
from jaxphoto.io import read_block, write_block
from jaxphoto.unknowns import FIXED, FREE
from jaxphoto.variants import direct, indirect, integrated
from tests.io.test_write_block import assert_same

PLACED = ("images.csv", "c,kodak,two,20.0,,,,,,", "c,kodak,two,20.0,20.0,0.0,100.0,0.0,0.0,90.0")
MODES = {"direct": direct, "integrated": integrated, "indirect": indirect}


def mode(name):
    return "block.toml", "[datum]", f'[georeferencing]\nmode = "{name}"\n[datum]'


def read_quietly(folder, name):
    """Image c has no station: direct georeferencing holds what images.csv says, and says so."""
    if name != "direct":
        return read_block(folder)
    with pytest.warns(UserWarning, match=r"mode = .direct.: 1 image\(s\) have no station and attitude.*exact: c$"):
        return read_block(folder)


@pytest.mark.parametrize("name", MODES)
def test_the_mode_is_the_variant_and_comes_back(write_folder, tmp_path, name):
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


def test_what_a_mode_cannot_be(write_folder):
    with pytest.raises(InputError, match=r"\[georeferencing\] mode: 'pure' is unknown; write .direct., .integrated."):
        read_block(write_folder(mode("pure")))


def test_direct_needs_an_orientation_of_every_image(write_folder):
    with pytest.raises(BlockError, match=r"image c has neither station and attitude nor .*\(1 image is so\)"):
        read_block(write_folder(mode("direct")))


def test_held_images_beside_their_sensors_cannot_be_written(write_folder, tmp_path):
    block = read_block(write_folder(PLACED))
    both = lambda b: (b.priors.exterior.position, b.priors.exterior.camera_from_object)  # noqa: E731
    for held in ((FIXED, FIXED), (FIXED, FREE)):
        with pytest.raises(BlockError, match=r"hold it by jaxphoto\.variants\.direct"):
            write_block(eqx.tree_at(both, block, held), tmp_path / "copy")
    assert not (tmp_path / "copy").exists()
