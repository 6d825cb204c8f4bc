"""surfaces.csv and [scanner]: round trips and refusals."""

import numpy as np
import pytest

from jaxphoto.errors import BlockError, InputError
from jaxphoto.io import read_block, write_block
from jaxphoto.unknowns import FREE, Weighted
from tests.io.test_write_block import assert_same

HEAD = (
    "point,foot_X_m,foot_Y_m,foot_Z_m,normal_X,normal_Y,normal_Z,turn_right_m,turn_forward_m,turn_up_m,sigma_m,strip\n"
)
ROWS = "p1,1.5,2.5,3.5,0.0,0.6,0.8,-800.0,10.0,2.0,0.1,east\np2,4.0,5.0,6.0,0.0,0.0,1.0,30.0,700.0,0.0,0.2,west\n"
SCANNER = """
[scanner]
boresight_deg = [0.1, -0.2, 0.3]
boresight = "free"
[scanner.shifts.west]
shift_m = [0.5, 0.0, -0.25]
shift = { sigma_m = 0.3 }
[scanner.shifts.east]
shift = "free"
"""


@pytest.fixture
def folder(write_folder):
    def write(rows: str = ROWS, scanner: str = SCANNER, head: str = HEAD):
        path = write_folder(("block.toml", "[datum]", scanner + "[datum]"))
        (path / "surfaces.csv").write_text(head + rows)
        return path

    return write


def test_read(folder):
    block = read_block(folder())
    rows, scanner, priors = block.surfaces, block.start.unknowns.scanner, block.priors.scanner
    assert [block.points[p] for p in rows.point] == ["p1", "p2"]
    assert [tuple(scanner.shifts)[s] for s in rows.strip] == ["east", "west"]
    np.testing.assert_array_equal(rows.normal, [[0, 0.6, 0.8], [0, 0, 1]])
    np.testing.assert_array_equal(rows.turn[1], [30, 700, 0])
    np.testing.assert_allclose(np.rad2deg(scanner.boresight), [0.1, -0.2, 0.3], rtol=1e-14)
    assert priors.boresight == FREE and priors.shifts["east"] == FREE
    assert isinstance(priors.shifts["west"], Weighted) and float(priors.shifts["west"].sigma[2]) == 0.3


@pytest.mark.parametrize("scanner", [SCANNER, ""])
def test_round_trip(folder, tmp_path, scanner):
    block = read_block(folder(scanner=scanner))
    assert (block.start.unknowns.scanner is None) == (scanner == "")
    write_block(block, tmp_path / "copy")
    assert_same(read_block(tmp_path / "copy"), block)


@pytest.mark.parametrize(
    ("old", "new", "error", "said"),
    [
        ("p1,", "nobody,", BlockError, "surfaces.csv, row 2: point nobody is measured in no image"),
        ("0.6,0.8", "0.6,0.9", InputError, "row 2: the normal has the length 1.08"),
        ("0.1,east", ",east", InputError, "row 2: sigma_m is empty"),
        ("0.2,west", "0.2,north", BlockError, r"row 3: strip 'north' has no table; add \[scanner.shifts.north\]"),
    ],
)
def test_bad_rows(folder, old, new, error, said):
    with pytest.raises(error, match=said):
        read_block(folder(ROWS.replace(old, new, 1)))


def test_bad_scanner(folder):
    with pytest.raises(InputError, match=r"\[scanner\] tilt: no such key"):
        read_block(folder(scanner=SCANNER.replace("boresight_deg", "tilt")))
