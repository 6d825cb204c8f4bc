"""Scripts of DBAT: lens models by its equations, camera files, prior orientations, and refusals."""

import numpy as np
import pytest

from jaxphoto.errors import InputError, JaxphotoError
from jaxphoto.extras.formats import read_tables
from jaxphoto.io.block_folder.camera_section import read_camera
from jaxphoto.io.toml import Section
from tests.sound_files import DBAT


def _read(folder):
    return read_tables(folder, "dbat")


PIXEL, C = 5.4 / 1704, 7.457
PX, PY, K, P, ASPECT = 3.61687, 2.61329, (4.6e-3, -4.5e-5, -2e-6), (-6.1e-5, -4.4e-5), 1 - 0.0039
VALUES = (
    f"<K>{','.join(map(repr, K))}</K><P>{','.join(map(repr, P))}</P><pp>{PX},{PY}</pp><cc>{C}</cc><aspect>{{}}</aspect>"
)


def script(folder, model, aspect=ASPECT, estimated="<all>false</all>"):
    text = DBAT["a.xml"].replace("<all>default</all>", "<all>loaded</all>")
    text = text.replace("<K>0,0,0</K><pp>0,0</pp>", VALUES.format(aspect)).replace("<model>3<", f"<model>{model}<")
    for name, content in DBAT.items():
        (folder / name).write_text(content)
    (folder / "a.xml").write_text(text.replace("<all>true</all><skew>false</skew>", estimated))
    return folder


def corrected(column, row, model):
    """DBAT's, from its (1, 1) in the upper left pixel: mm, y up, reduced to the principal point, without distortion."""
    x, y = column * PIXEL, -row * PIXEL
    # What it calls aspect is 1 - as, and 1 + as is what x is multiplied by.
    scale = 1 + (1 - ASPECT)
    before, after = (scale, 1.0) if model in (3, 5) else (1.0, scale if model == 4 else 1.0)
    x, y = (x * before - PX, y + PY) if model == 5 else ((x - PX) * before, y + PY)
    r2 = x * x + y * y
    radial = K[0] * r2 + K[1] * r2**2 + K[2] * r2**3
    return np.stack([
        after * (x + x * radial + P[0] * (r2 + 2 * x * x) + 2 * P[1] * x * y),
        y + y * radial + P[1] * (r2 + 2 * y * y) + 2 * P[0] * x * y,
    ])  # fmt: skip


@pytest.mark.parametrize("model", [1, 2, 3, 4, 5])
def test_lens_models_agree_with_dbat(tmp_path, model):
    tables = _read(script(tmp_path, model, ASPECT if model > 2 else 1.0))
    ((name, values),) = tables.settings["cameras"].items()
    sensor, interior, *_ = read_camera(Section("a", name, dict(values)))
    for column, row in ((1.0, 1.0), (2272.0, 30.0), (700.5, 1704.0)):
        xy = sensor.mm_from_px(np.array([[column - 0.5, row - 0.5]]))[0]
        ideal = interior.distortion.closed_form(xy - np.array([float(interior.xp), float(interior.yp)]))
        np.testing.assert_allclose(ideal, corrected(column, row, model), rtol=0, atol=1e-12)


def test_the_principal_point_of_model_5_is_that_of_model_3_in_the_reports_of_dbat(tmp_path):
    """Of one calibration by both: 3.61687 mm with as 0.000389598, and 3.61546 mm."""
    tables = _read(script(tmp_path, 5, 1 - 0.000389598))
    (values,) = tables.settings["cameras"].values()
    assert values["interior"]["xp_mm"] + PIXEL * (2272 / 2 + 0.5) == pytest.approx(3.61546, abs=5e-6)


@pytest.mark.parametrize(
    ("model", "aspect", "estimated", "message"),
    [
        (2, 0.99, "<all>false</all>", "lens model 2 has neither aspect nor skew"),
        (1, 1.0, "<all>true</all>", "lens model 1 has neither aspect nor skew"),
        (6, 1.0, "<all>true</all>", "lens model '6' is not supported; use one of 1, 2, 3, 4, 5"),
    ],
)
def test_a_lens_model_that_has_no_equal_is_refused(tmp_path, model, aspect, estimated, message):
    with pytest.raises(InputError, match=message):
        _read(script(tmp_path, model, aspect, estimated))


def eo_script(folder, form="id,x,y,z,omega,phi,kappa", units="gon", rows="2,1.5,2.5,9,10,-20,100\n1,1,2,8,5,0,50\n"):
    """With the camera in a file of its own, and <prior_eo>."""
    script(folder, 3)
    text = (folder / "a.xml").read_text()
    camera = text[text.index("<cameras>") : text.index("</cameras>") + len("</cameras>")]
    (folder / "camera.txt").write_text(f'<document dbat_camera_version="1.0">{camera}</document>')
    (folder / "eo.txt").write_text(rows)
    prior = f'<prior_eo><file format="{form}" units="{units}">eo.txt</file></prior_eo>'
    (folder / "a.xml").write_text(text.replace(camera, prior + "<cameras><file>camera.txt</file></cameras>"))
    return folder


def test_a_camera_in_a_file_is_that_of_the_script(tmp_path):
    (tmp_path / "one").mkdir()
    (tmp_path / "two").mkdir()
    one, two = _read(script(tmp_path / "one", 3)), _read(eo_script(tmp_path / "two"))
    assert one.settings["cameras"] == two.settings["cameras"]


def test_prior_orientations_are_start_values(tmp_path):
    images = _read(eo_script(tmp_path)).tables["images"]
    assert images.text("image").tolist() == ["one", "two"]
    names = ("X_m", "Y_m", "Z_m", "omega_deg", "phi_deg", "kappa_deg")
    found = np.stack([images.numbers(name) for name in names], axis=1)
    np.testing.assert_allclose(found, [(1, 2, 8, 4.5, 0, 45), (1.5, 2.5, 9, 9, -18, 90)], rtol=0, atol=1e-12)


def test_prior_positions_with_standard_deviations_are_stations(tmp_path):
    tables = _read(eo_script(tmp_path, "id,x,y,z,sxyz", "", "2,1.5,2.5,9,0.05\n")).tables
    assert "X_m" not in tables["images"] and tables["stations"].ids("image").tolist() == ["two"]
    assert [tables["stations"].numbers(name)[0] for name in ("Z_m", "sigma_X_m", "sigma_Z_m")] == [9, 0.05, 0.05]


def test_a_dependent_datum_is_a_minimal_one(tmp_path):
    path = script(tmp_path, 3) / "a.xml"
    datum = '<operation><set_datum ref_cam="1" ref_base="longest">depend</set_datum></operation></operations>'
    path.write_text(path.read_text().replace("</operations>", datum))
    assert _read(tmp_path).settings["datum"] == {"kind": "minimal"}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"units": "turns"}, "'turns' is not supported; use one of degrees, radian, gon"),
        ({"form": "id,x,y,z,omega,phi,skappa"}, "the unsupported column 'skappa'"),
        ({"rows": "7,1,2,8,5,0,50\n"}, r"eo.txt, row 1: image 7 is not in images.txt"),
    ],
)
def test_invalid_prior_orientations_are_refused(tmp_path, change, message):
    with pytest.raises(JaxphotoError, match=message):
        _read(eo_script(tmp_path, **change))


def test_a_camera_file_without_camera_is_refused(tmp_path):
    (eo_script(tmp_path) / "camera.txt").write_text("<document/>")
    with pytest.raises(InputError, match="0 <camera> in <cameras> or its camera file"):
        _read(tmp_path)
