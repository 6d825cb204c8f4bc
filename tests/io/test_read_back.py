"""What was exported comes back by `read_source`: whole, and adjusting to the same values."""

import numpy as np
import pytest

import jaxphoto
from jaxphoto.camera import get_parameter, parameter_names
from jaxphoto.io import AdjustedPhotographs, export, read_source
from tests.io.oriented_files import inside

# Formats whose image points stand beside their files.
BESIDE = {"metashape": "agisoft", "nerfstudio": "opencv", "orthority": "opencv", "opk": "opencv"}


@pytest.mark.filterwarnings("ignore:.*fewer than")
@pytest.mark.parametrize("format", BESIDE)
def test_image_points_come_back_with_their_standard_deviations(tmp_path, format):
    p = inside(BESIDE[format], "epsg" if format != "nerfstudio" else "local")
    sigma = np.random.default_rng(1).uniform(0.2, 2.0, len(p.image))
    export(p._replace(sigma_px=np.repeat(sigma[:, None], 2, axis=1)), tmp_path / "out", format)
    block = read_source(tmp_path / "out")
    rows = zip(p.image, p.point, p.column_row, sigma, strict=True)
    given = {(p.images[i], p.points[j]): (*at, s, s) for i, j, at, s in rows}
    again = AdjustedPhotographs.of_block(block, block.start.unknowns)
    assert len(again.image) > 60
    for i, j, at, s in zip(again.image, again.point, again.column_row, again.sigma_px, strict=True):
        np.testing.assert_allclose((*at, *s), given[again.images[i], again.points[j]], rtol=0, atol=1e-9)


@pytest.mark.filterwarnings("ignore:.*fewer than")
def test_standard_deviations_that_differ_by_axis_are_told(tmp_path):
    p = inside("opencv", "local")
    with pytest.warns(UserWarning, match="image_points.csv has one standard deviation for x and y"):
        export(p._replace(sigma_px=np.tile([3.0, 4.0], (len(p.image), 1))), tmp_path / "out", "nerfstudio")
    block = read_source(tmp_path / "out")
    np.testing.assert_allclose(np.asarray(block.image_points.sigma) / 0.001, np.sqrt(12.5), rtol=1e-12)


@pytest.mark.filterwarnings("ignore:.*fewer than")
@pytest.mark.parametrize("format", ["metashape", "nerfstudio", "orthority"])
def test_a_block_adjusts_to_the_same_values_again(tmp_path, format):
    p = inside(BESIDE[format], "local")
    rng = np.random.default_rng(2)
    sigma = np.repeat(rng.uniform(0.2, 0.4, len(p.image))[:, None], 2, axis=1)
    p = p._replace(column_row=p.column_row + rng.normal(0, 0.3, (len(p.image), 2)), sigma_px=sigma)
    export(p, tmp_path / "first", format)
    first = jaxphoto.adjust(read_source(tmp_path / "first").fix("k3"))
    assert first.converged
    export(AdjustedPhotographs.of(first), tmp_path / "again", format)
    again = jaxphoto.adjust(read_source(tmp_path / "again").fix("k3"))
    assert float(again.sigma0) == pytest.approx(float(first.sigma0), rel=1e-9)
    (one,) = first.unknowns.interior.values()
    (two,) = again.unknowns.interior.values()
    for name in parameter_names(one):
        assert float(get_parameter(two, name)) == pytest.approx(float(get_parameter(one, name)), abs=1e-7), name
