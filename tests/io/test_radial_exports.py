"""BAL and Bundler with cameras f, k1, k2: rays are kept by the equations of each format; round trips."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from jaxphoto.camera import BundlerRadial, Equisolid, InteriorOrientation, OpenCv
from jaxphoto.errors import InputError
from jaxphoto.extras.formats import ProjectCamera, export, read_tables
from jaxphoto.io import read_block
from tests.commands import run
from tests.io.oriented_files import come_back, inside, posed, poses
from tests.io.test_exports import SENSOR


def bal_of(folder):
    """Rotations, translations, (f, k1, k2), points, and rows of camera, point, x, y of a problem."""
    (path,) = folder.glob("problem-*-pre.txt")
    words = path.read_text().split()
    n, m, k = map(int, words[:3])
    rows = np.array(words[3 : 3 + 4 * k], float).reshape(-1, 4)
    values = np.array(words[3 + 4 * k :], float)
    cameras = values[: 9 * n].reshape(-1, 9)
    xyz = values[9 * n :].reshape(m, 3)
    return Rotation.from_rotvec(cameras[:, :3]).as_matrix(), cameras[:, 3:6], cameras[:, 6:], xyz, rows


def misfits_px(folder):
    """Measured minus computed, by p = -P / P_z and f (1 + k1 |p|^2 + k2 |p|^4) p."""
    turns, moved, values, xyz, rows = bal_of(folder)
    camera, point = rows[:, :2].astype(int).T
    seen = np.einsum("nij,nj->ni", turns[camera], xyz[point]) + moved[camera]
    p = -seen[:, :2] / seen[:, 2:]
    f, k1, k2 = values[camera].T
    r2 = (p**2).sum(axis=1)
    return rows[:, 2:] - (f * (1 + k1 * r2 + k2 * r2**2))[:, None] * p


def named(p):
    """With names that a list with blanks holds."""
    return p._replace(files=tuple(name.replace(" ", "_") for name in p.files))


@pytest.mark.parametrize("camera", ["agisoft", "brown", "opencv", "rational"])
def test_rays_are_kept(tmp_path, camera):
    """Of cameras with a principal point, tangential and affine terms, none of which the formats have."""
    done = export(named(inside(camera, "local")), tmp_path / "out", "bal")
    assert np.abs(misfits_px(tmp_path / "out")).max() < 1e-6
    said = done.cameras["one"]
    rms_px, max_px = done.moved_px
    assert 0 < said.rms_px < 10 and 0 < rms_px <= max_px < 2 * said.max_px


def test_residuals_are_preserved(tmp_path):
    """What was measured wrong by pixels is so by the same afterwards, but for how the fit stretches there."""
    p = named(inside("agisoft", "local"))
    noise = np.random.default_rng(3).normal(0, 2.0, p.column_row.shape)
    export(p._replace(column_row=p.column_row + noise), tmp_path / "out", "bal")
    order = np.lexsort((p.image, p.point))
    np.testing.assert_allclose(misfits_px(tmp_path / "out"), noise[order] * [1, -1], atol=0.1)


term = st.floats(-0.2, 0.2)


@settings(max_examples=25, deadline=None)
@given(values=poses, c=st.floats(2.0, 200.0), at=st.tuples(term, term), k1=term, k2=term)
def test_cameras_poses_points_and_image_points_round_trip(tmp_path_factory, values, c, at, k1, k2):
    folder = tmp_path_factory.mktemp("radial")
    p = named(posed(values, InteriorOrientation(c, *at, BundlerRadial(k1, k2))))
    done = export(p, folder, "bal")
    assert done.cameras["one"].max_px == 0 and done.moved_px == (0, 0)
    tables = read_tables(folder, "bal")
    come_back(p, tables, [str(k) for k in range(4)])
    assert len(tables.settings["cameras"]) == 4
    for camera in tables.settings["cameras"].values():
        wanted = {"c_mm": c / SENSOR.pixel_mm * camera["pixel_mm"], "k1": k1, "k2": k2}
        for name, value in camera["interior"].items():
            assert value == pytest.approx(wanted.get(name, 0.0), abs=1e-9)
    *_, rows = bal_of(folder)
    order = np.lexsort((p.image, p.point))
    wanted = (SENSOR.mm_from_px(p.column_row[order]) - at) / SENSOR.pixel_mm
    np.testing.assert_allclose(rows[:, 2:], wanted, rtol=0, atol=1e-9)


def test_cameras_without_an_equivalent_are_refused(tmp_path):
    p = named(inside("brown", "local"))
    wide = InteriorOrientation(3.0, 0.0, 0.0, projection=Equisolid())
    with pytest.raises(InputError, match="is a fisheye, but cameras of bal are perspective"):
        export(p._replace(cameras={"one": ProjectCamera(SENSOR, wide)}), tmp_path / "out", "bal")
    with pytest.raises(InputError, match=r"images.txt allows no blanks, but 'a b.jpg' has one"):
        export(inside("opencv", "local"), tmp_path / "out", "colmap")
    # Its rays turn back outside the format.
    far = p.column_row.copy()
    far[7] = (-9000.0, 0.0)
    folds = {"one": ProjectCamera(SENSOR, InteriorOrientation(8.8, 0.0, 0.0, OpenCv(-0.1, 0.0, -0.02, p1=1e-3)))}
    with pytest.raises(InputError, match=f"point {p.points[p.point[7]]} in image a b is where the distortion of c"):
        export(p._replace(cameras=folds, column_row=far), tmp_path / "out", "bal")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("format", ["bal", "metashape"])
def test_the_command_writes_and_reads_again(tmp_path, monkeypatch, capsys, format):
    code, said, _ = run(monkeypatch, capsys, "convert", "examples/cross_block", tmp_path / "out", "--to", format)
    assert code == 0 and f"wrote {tmp_path / 'out'}" in said
    assert ("image points are relative to the principal point\n" in said) == (format == "bal")
    code, said, _ = run(monkeypatch, capsys, "convert", tmp_path / "out", tmp_path / "block")
    assert code == 0 and ("pixel size 0.001 mm assumed" in said) == (format == "bal")
    given, again = read_block("examples/cross_block"), read_block(tmp_path / "block")
    assert len(again.image_points.image) == len(given.image_points.image)
    if format == "metashape":
        assert len(again.control.who) == len(given.control.who) + len(given.fixed.who)
