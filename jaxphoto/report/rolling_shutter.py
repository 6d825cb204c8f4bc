"""What a block says of a rolling shutter, in words."""

from collections.abc import Iterator

from jaxphoto.camera import RollingShutter
from jaxphoto.errors import camera_words
from jaxphoto.report.findings import Finding, Level
from jaxphoto.report.tables import Tables

# Of its standard deviation: a smaller readout is none that is seen.
SEEN = 3.0


def readout_of(camera: str) -> str:
    """What the readout of a camera is called among the parameters of mounts and strips."""
    return f"{RollingShutter.kind}[{camera}].readout_ms"


def shutter_findings(tables: Tables) -> Iterator[Finding]:
    """The readout of every camera that has an unknown one, and whether there is any."""
    table = tables.georeferencing
    for label, value, sigma in table[table["parameter"].str.startswith(f"{RollingShutter.kind}[")].to_numpy():
        camera = label.split("[", 1)[1].rsplit("]", 1)[0]
        order = "first row first" if value > 0 else "last row first"
        said = f"{camera_words(camera)} reads its rows in {abs(value):.3g} +- {sigma:.2g} ms ({order})"
        if abs(value) < SEEN * sigma:
            said = f"no rolling shutter of {camera_words(camera)} is seen: readout {value:.2g} +- {sigma:.2g} ms"
        yield Finding(Level.INFORMATION, said)
