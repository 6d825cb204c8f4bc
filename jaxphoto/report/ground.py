"""What the camera shares with the ground, in words."""

from collections.abc import Iterator

import numpy as np

from jaxphoto.errors import camera_words
from jaxphoto.report.findings import Finding, Level
from jaxphoto.report.tables import Tables
from jaxphoto.statistics.correlation import FORMS, GroundCorrelations

HIGH = 0.9
_WORDS = {
    "height": "the height of the ground",
    "flying_height": "the flying height over the ground",
    "dome": "a dome of the ground (its middle over its edge)",
}
_CURES = {
    "c_mm": "heights known on the ground, another flying height or oblique images tell them apart",
    "all": "control in the middle and at the edge of the ground, oblique images or crossing strips tell them apart",
}


# Where no station is observed nobody flies, or needs not know how high.
_WITHOUT_STATIONS = "images from other distances, or tilted ones, tell them apart"


def ground_findings(tables: Tables) -> Iterator[Finding]:
    """How c goes with the heights, and the camera as a whole with the dome, where nothing tells them apart."""
    for camera, g in tables.ground_correlations.items():
        yield from (Finding(Level.INFORMATION, text) for text in _sentences(camera, g, tables))


def _sentences(camera: str, g: GroundCorrelations, tables: Tables) -> Iterator[str]:
    known = tables.interior[tables.interior["camera"] == camera].set_index("parameter")["sigma"]
    if "c_mm" in g.parameters:
        rho = g.rho[:2, g.parameters.index("c_mm")]
        k = int(np.abs(rho).argmax())
        if abs(rho[k]) > HIGH:
            flown = len(tables.adjusted.block.stations.who) > 0
            words = _WORDS[FORMS[k]] if flown or k == 0 else "the distance of the images from the points"
            what = "height" if flown or k == 0 else "distance"
            yield (
                f"c of {camera_words(camera)} goes with {words} (correlation {rho[k]:.3f}): if c is off by "
                f"its standard deviation of {known['c_mm']:.2g} mm, the {what} is by {abs(rho[k]) * g.sigma_m[k]:.2g} "
                f"m, and no residual shows it; {_CURES['c_mm'] if flown else _WITHOUT_STATIONS}"
            )
    dome = FORMS.index("dome")
    if g.together[dome] > HIGH:
        yield (
            f"{camera_words(camera)} as a whole goes with {_WORDS['dome']} (multiple correlation "
            f"{g.together[dome]:.3f}): one standard deviation of it is {g.sigma_m[dome]:.2g} m of dome, and no "
            f"residual shows it; {_CURES['all']}"
        )
