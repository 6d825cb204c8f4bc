"""The page of a block of many cameras has pictures of some of them, and says of which."""

import pytest

from jaxphoto import Tables
from jaxphoto.report import results, verdict_of
from tests.blocks import adjusted


@pytest.fixture
def of_points(monkeypatch):
    """Tables of two cameras of which one is pictured, and the names by the number of image points."""
    tables = Tables(adjusted("two_cameras"))
    monkeypatch.setattr(results, "_PLOTTED", 1)
    of = tables.adjusted.block.image_camera
    seen = [of[i] for i in tables.adjusted.structure.image.tolist()]
    return tables, sorted(("one", "two"), key=seen.count)


def test_of_many_cameras_those_with_the_most_image_points_are_pictured(of_points):
    tables, (_, most) = of_points
    assert results.plotted_cameras(tables) == [most]


@pytest.mark.slow
def test_the_page_says_of_which_cameras_its_pictures_are(of_points):
    tables, (other, most) = of_points
    told = results.report_page(tables, verdict_of(tables))
    assert f"Plots show 1 of 2 cameras, those with the most image points: {most}." in told
    for what in ("image residuals", "mean residuals"):
        assert f'"{what} of camera {most}"' in told
        assert f'"{what} of camera {other}"' not in told
