"""Figures of a page that answer, and its block, which turns too: with plotly inside, so that it opens offline."""

from __future__ import annotations

import base64
import functools
import gzip
import json
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from markupsafe import Markup

from jaxphoto.adjustment import Adjustment
from jaxphoto.report.block_in_space import block_in_space, drawable, origin_of
from jaxphoto.report.block_places import places_of
from jaxphoto.report.to_plotly import twins_of
from jaxphoto.statistics import Covariance

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawn
    from plotly.graph_objects import Figure

# Image points whose residuals a page holds, some 12 bytes each; of more, every so manyeth.
_MOST = 600_000
_STEPS = np.iinfo(np.int16).max
# What the script, and a page that is put together, know figures by.
_LIVE = "live-figure"
# Residuals are shown to a hundredth of a pixel: half of that is fine enough, and packs better than noise.
_FINE_PX = 0.005


def live_block(adjusted: Adjustment, covariance: Covariance, still: str, alt: str) -> Markup:
    """The block as a figure that turns, with what is shown of an image or point that is chosen; once a page.

    `still` is the picture that stands for it in print and where no script runs, as the address of an image, and `alt`
    says what it shows.
    """
    figure: Figure = block_in_space(adjusted, covariance)
    shown = f'<figure class="block {_LIVE}"><img alt="{{}}" src="{{}}" class="still">{{}}</figure>{{}}'
    return Markup(shown).format(
        alt,
        still,
        _packed(figure.to_json(), "figure"),
        _packed(json.dumps(measurements(adjusted)), "measurements"),
    )


def live_figure(still: Markup, drawn: Sequence[Drawn]) -> Markup:
    """Pictures that stand in a page as `still`, in print and where no script runs, each of their panels as its twin.

    Panels stand as many abreast as they do in a picture, where there is room; above them its title.
    """
    packed = _packed(f"[{','.join(twin.to_json() for one in drawn for twin in twins_of(one))}]")
    specs = [axes.get_subplotspec() for one in drawn for axes in one.axes]
    across = max([len(drawn), *(spec.get_gridspec().ncols for spec in specs if spec is not None)])
    title = next(filter(None, (one.get_suptitle() for one in drawn)), "")
    caption = Markup("<figcaption>{}</figcaption>").format(title) if title else ""
    shown = f'<figure class="twins {_LIVE}" style="--across: {across}"><div class="still">{{}}</div>{{}}{{}}</figure>'
    return Markup(shown).format(still, packed, caption)


def library(parts: Iterable[Markup]) -> Markup:
    """What draws the figures of a page, once, where it has any."""
    return _plotly() if any(_LIVE in part for part in parts) else Markup("")


def measurements(adjusted: Adjustment) -> dict:
    """Of every image its points with their residuals, for what is shown of a chosen one.

    `point`, `xy` and `v` run over image points in the order of their images, `first` says where each image begins; `xy`
    and `v` are whole numbers of `xy_step_mm` and `v_step_mm`. Of more than 600,000 image points, every so manyeth.
    """
    block, places = adjusted.block, places_of(adjusted)
    image = np.asarray(adjusted.structure.image)
    order = np.argsort(image, kind="stable")[:: max(1, -(-len(image) // _MOST))]
    xy = np.asarray(adjusted.values.xy)[:, order]
    v = (np.asarray(adjusted.residuals.image) * np.asarray(adjusted.values.sigma_xy))[:, order]
    cameras = list(block.sensors)
    origin = origin_of(places)
    steps: dict[str, Any] = {}
    fine = _FINE_PX * min(sensor.pixel_mm for sensor in block.sensors.values())
    for name, of, least in (("xy", xy, 0.0), ("v", v, fine)):
        # Where an adjustment diverged, residuals are no numbers.
        finite = np.where(np.isfinite(of), of, 0.0)
        step = max(float(np.abs(finite).max(initial=0.0)) / _STEPS, least) or 1.0
        steps |= {name: _array(np.round(finite.T / step), "i2"), f"{name}_step_mm": step}
    return {
        "images": list(block.images),
        "points": list(block.points),
        "camera": [cameras.index(c) for c in block.image_camera],
        "cameras": [
            {"width_mm": s.width_mm, "height_mm": s.height_mm, "pixel_mm": s.pixel_mm} for s in block.sensors.values()
        ],
        "first": _array(np.searchsorted(image[order], np.arange(len(block.images) + 1)), "i4"),
        "point": _array(np.asarray(adjusted.structure.point)[order], "i4"),
        **steps,
        "stations": _array(drawable(places.stations - origin), "f4"),
        "places": _array(drawable(places.points - origin), "f4"),
    }


def _array(values: np.ndarray, dtype: str) -> dict[str, str]:
    """Numbers as plotly writes them: little-endian bytes in base64."""
    return {"dtype": dtype, "bdata": base64.b64encode(values.astype(f"<{dtype}").tobytes()).decode()}


@functools.cache
def _plotly() -> Markup:
    """plotly.js: packed, it is 2 MB in place of 5."""
    # Here, because importing plotly takes half a second that most uses of jaxphoto need not wait for.
    from plotly.offline import get_plotlyjs

    return _packed(get_plotlyjs(), "plotly")


def _packed(text: str, name: str = "") -> Markup:
    """A text that the page unpacks when it is asked for, by its name where it has one; the same bytes each time."""
    content = base64.b64encode(gzip.compress(text.encode(), mtime=0)).decode()
    known = Markup(' id="{}"').format(name) if name else ""
    return Markup('<script type="text/plain"{}>{}</script>').format(known, content)
