"""Cameras of DBAT's scripts: its lens models by their own equations, written down independently, and their refusals."""

import numpy as np
import pytest

from jaxphoto.errors import InputError
from jaxphoto.io.block_folder.camera_section import read_camera
from jaxphoto.io.block_folder.section import Section
from jaxphoto.io.dbat import read_dbat
from tests.sound_files import DBAT

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
    scale = 1 + (1 - ASPECT) if model in (3, 5) else 1.0
    x, y = (x * scale - PX, y + PY) if model == 5 else ((x - PX) * scale, y + PY)
    r2 = x * x + y * y
    radial = K[0] * r2 + K[1] * r2**2 + K[2] * r2**3
    return np.stack([
        x + x * radial + P[0] * (r2 + 2 * x * x) + 2 * P[1] * x * y,
        y + y * radial + P[1] * (r2 + 2 * y * y) + 2 * P[0] * x * y,
    ])  # fmt: skip


@pytest.mark.parametrize("model", [1, 2, 3, 5])
def test_a_lens_model_of_dbat_is_what_it_computes(tmp_path, model):
    tables = read_dbat(script(tmp_path, model, ASPECT if model in (3, 5) else 1.0))
    ((name, values),) = tables.settings["cameras"].items()
    sensor, interior, *_ = read_camera(Section("a", name, dict(values)))
    for column, row in ((1.0, 1.0), (2272.0, 30.0), (700.5, 1704.0)):
        xy = sensor.mm_from_px(np.array([[column - 0.5, row - 0.5]]))[0]
        ideal = interior.distortion.closed_form(xy - np.array([float(interior.x_p), float(interior.y_p)]))
        np.testing.assert_allclose(ideal, corrected(column, row, model), rtol=0, atol=1e-12)


def test_the_principal_point_of_model_5_is_that_of_model_3_in_the_reports_of_dbat(tmp_path):
    """Of one calibration by both: 3.61687 mm with as 0.000389598, and 3.61546 mm."""
    tables = read_dbat(script(tmp_path, 5, 1 - 0.000389598))
    (values,) = tables.settings["cameras"].values()
    assert values["interior"]["xp_mm"] + PIXEL * (2272 / 2 + 0.5) == pytest.approx(3.61546, abs=5e-6)


@pytest.mark.parametrize(
    ("model", "aspect", "estimated", "message"),
    [
        (2, 0.99, "<all>false</all>", "lens model 2 has neither aspect nor skew"),
        (1, 1.0, "<all>true</all>", "lens model 1 has neither aspect nor skew"),
        (5, 1.0, "<all>true</all>", "the skew of lens model 5 has no equal here"),
        (4, 1.0, "<all>true</all>", "lens model 4 has no equal here"),
    ],
)
def test_a_lens_model_that_has_no_equal_is_refused(tmp_path, model, aspect, estimated, message):
    with pytest.raises(InputError, match=message):
        read_dbat(script(tmp_path, model, aspect, estimated))
