"""Results that contradict themselves: refused with the row or the file."""

import pytest

from jaxphoto.errors import InputError
from jaxphoto.io.camera_files import read_camera_file
from tests.io import test_cameras as good


def table(rows):
    return "parameter_a,parameter_b,rho\n" + "".join(
        f"interior[nadir].{a},interior[nadir].{b},{r}\n" for a, b, r in rows
    )


PAIRS = [("c_mm", "xp_mm", 0.25), ("c_mm", "k1", 0.75), ("xp_mm", "k1", 0.5)]
IMPOSSIBLE = [("c_mm", "xp_mm", 0.9), ("c_mm", "k1", -0.9), ("xp_mm", "k1", 0.9)]


@pytest.mark.parametrize(
    "rows",
    [
        PAIRS,
        [*PAIRS, *[(b, a, r + 0.1) for a, b, r in PAIRS]],
        [*PAIRS, *[(b, a, r) for a, b, r in PAIRS[:2]], PAIRS[0]],
        [*PAIRS, *[(b, a, "much") for a, b, r in PAIRS]],
        [(*pair, r) for a, b, r in IMPOSSIBLE for pair in ((a, b), (b, a))],
        [(*pair, 1.5) for a, b, _ in PAIRS for pair in ((a, b), (b, a))],
    ],
    ids=["one way", "not alike", "twice", "text", "impossible together", "above 1"],
)  # fmt: skip
def test_correlations_that_are_none_are_refused(tmp_path, rows):
    block = good.written(tmp_path, good.TOML, "b.toml")
    folder = good.results_folder(tmp_path)
    good.written(tmp_path, table(rows), "correlation.csv")
    with pytest.raises(InputError, match=r"interior.csv: correlation.csv beside it is not of the same adjustment"):
        read_camera_file(folder, block=block)
    good.written(tmp_path, "a,b\n1,2\n", "correlation.csv")
    with pytest.raises(InputError, match=r"correlation.csv beside it is no table of parameter_a, parameter_b, rho"):
        read_camera_file(folder, block=block)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("nadir,yp_mm", "nadir,xp_mm", "row 4: xp_mm of camera nadir stands there twice"),
        ("0.002,True", "-0.002,True", "row 2: sigma is -0.002"),
        ("r0_mm,8.0", "r0_mm,-8.0", "r0_mm of camera nadir is -8; give it as a positive length"),
        ("r0_mm,8.0", "r0_mm,nan", "row 14: value is 'nan'; give a finite number"),
        ("35.5", "-35.5", "c_mm of camera nadir is -35.5; a principal distance is positive"),
    ],
)
def test_an_interior_csv_that_contradicts_itself_is_refused(tmp_path, old, new, message):
    block = good.written(tmp_path, good.TOML, "b.toml")
    folder = good.results_folder(tmp_path)
    good.written(tmp_path, good.INTERIOR.replace(old, new, 1), "interior.csv")
    with pytest.raises(InputError, match=message):
        read_camera_file(folder, block=block)
