"""PhotoModeler's text export by its equations, alone and with control, and refusals."""

import numpy as np
import pytest

from jaxphoto.camera import AffineBrown, Brown
from jaxphoto.errors import JaxphotoError
from jaxphoto.extras.formats import read_source
from tests.formulas import camera_from_object
from tests.io.oriented_files import misfits_px
from tests.io.test_reconstructions import free_of

WIDTH, HEIGHT, PIXEL = 2272, 1704, 5.4 / 1704
C, PX, PY = 7.4653, 3.6173, 2.6128
K, P = (0.005, -1e-4, 1e-6), (-6e-5, -4e-5)
POSITIONS = np.array([[-0.6, -0.1, 1.6], [0.5, 0.2, 1.7], [0.1, -0.6, 1.5]])
# kappa, phi, omega, as the export lists them.
ANGLES = np.array([[-179.8, -20.2, 4.4], [-90.1, 17.8, -6.7], [12.0, 2.5, 21.3]])
POINTS = np.random.default_rng(4).uniform([-0.5, -0.4, -0.1], [0.5, 0.4, 0.1], (9, 3))


def corrected(x, y):
    """PhotoModeler's help: what is added to a coordinate that is reduced to the principal point."""
    r2 = x * x + y * y
    radial = K[0] * r2 + K[1] * r2**2 + K[2] * r2**3
    dpx = P[0] * (r2 + 2 * x * x) + 2 * P[1] * x * y
    dpy = P[1] * (r2 + 2 * y * y) + 2 * P[0] * x * y
    return x + x * radial + dpx, y + y * radial + dpy


def seen(k, pixel_x):
    """Column and row, counted from (1, 1) at the centre of the first pixel."""
    kappa, phi, omega = np.radians(ANGLES[k])
    u, v, w = camera_from_object(omega, phi, kappa) @ (POINTS - POSITIONS[k]).T
    x0, y0 = -C * u / w, -C * v / w
    x, y = x0, y0
    for _ in range(60):
        cx, cy = corrected(x, y)
        x, y = x + x0 - cx, y + y0 - cy
    return (x + PX) / pixel_x, (PY - y) / PIXEL


def export_text(pixel_x=PIXEL, control=""):
    camera = f"{C} {PX} {PY} {pixel_x * WIDTH!r} {PIXEL * HEIGHT!r} {' '.join(map(repr, (*K, *P)))}"
    lines = ["Bundle Soln test", f"0.0005 20 {WIDTH} {HEIGHT}", "1 0.1 10 10 10 10 20 20 20", camera, "0 " * 10]
    marks = []
    for k in range(3):
        outer = " ".join(map(repr, [*POSITIONS[k].tolist(), *ANGLES[k].tolist()]))
        lines += [
            f"{k} some folder/{'abc'[k]} 1.jpg",
            f"{k} {outer}",
            f"{k} 1 1 1 1 1 1",
            "",
            f"{k} {camera}",
            f"{k} 0",
        ]
        marks += [
            f"{k} {10 + j} {x!r} {y!r} 0.1 0.1" for j, (x, y) in enumerate(np.stack(seen(k, pixel_x), 1).tolist())
        ]
    rows = [f"{10 + j} {' '.join(map(repr, at))} 0.001 0.001 0.001" for j, at in enumerate(POINTS.tolist())]
    return "\n".join([*lines, "", *([control] if control else []), "", *rows, "", *marks, "", "1 1 10"])


@pytest.mark.parametrize(("pixel_x", "kind"), [(PIXEL, Brown), (1.0004 * PIXEL, AffineBrown)])
def test_an_export_alone_is_a_block_with_its_distortion(tmp_path, pixel_x, kind):
    (tmp_path / "anything.txt").write_text(export_text(pixel_x))
    block = read_source(tmp_path)
    assert block.images == ("a 1", "b 1", "c 1") and len(block.points) == 9 and block.datum.kind == "inner"
    assert type(block.start.unknowns.interior["camera"].distortion) is kind
    # What is counted is from a corner half a pixel off, as in DBAT.
    assert np.abs(misfits_px(block, POINTS[[int(name) - 10 for name in block.points]])).max() < 1e-6
    b1 = {"b1"} if kind is AffineBrown else set()
    assert free_of(block, "camera") == {"c_mm", "xp_mm", "yp_mm", "k1", "k2", "k3", "p1", "p2"} | b1


def test_control_of_an_export_holds_where_its_sigmas_are_negative(tmp_path):
    rows = [f"{10 + j} {' '.join(map(repr, POINTS[j].tolist()))} {s} {s} {s}" for j, s in enumerate((-1.8, -1.8, 0.01))]
    (tmp_path / "a.txt").write_text(export_text(control="\n".join(rows)))
    block = read_source(tmp_path)
    assert {block.points[k] for k in block.fixed.who} == {"10", "11"}
    assert {block.points[k] for k in block.control.who} == {"12"} and block.datum.kind == "control"


def _changed(old, new):
    return export_text().replace(old, new, 1)


REFUSED = {
    "size": (_changed(f"20 {WIDTH} {HEIGHT}", "20"), "row 2: no size of the photographs; write width"),
    "outer": (_changed("0 -0.6 -0.1", "0 -0.6 x"), "row 7: .* is not 7 numbers"),
    "cells": (_changed("\n10 ", "\n10 1 "), r"row \d+: expected 7 numbers"),
    "cut": ("\n".join(export_text().split("\n")[:8]), "row 6: '0 some folder/a 1.jpg' does not start a photograph"),
    "image": (_changed("2 18 ", "9 18 "), "image 9 is not among the export's images"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_invalid_exports_are_refused(tmp_path, name):
    text, message = REFUSED[name]
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(JaxphotoError, match=message):
        read_source(tmp_path, "photomodeler")
