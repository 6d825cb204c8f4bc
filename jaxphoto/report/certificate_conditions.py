"""Flight and conditions of a calibration in words; what nobody told is said, too."""

from collections.abc import Iterator, Sequence

import numpy as np

from jaxphoto.camera.conditions import Conditions
from jaxphoto.report.certified import Certified

_UNSAID = "not said by the photographs"
_QUANTITIES = (
    ("exposure", "exposure_s", "s"),
    ("f-number", "f_number", ""),
    ("sensitivity", "iso", "ISO"),
    ("focal length", "focal_length_mm", "mm (as the lens says it)"),
    ("focused at", "subject_distance_m", "m"),
    ("temperature", "temperature_c", "degrees Celsius"),
    ("relative humidity", "humidity_percent", "%"),
    ("air pressure", "pressure_hpa", "hPa"),
)


def flight_rows(given: Certified) -> Iterator[tuple[str, str]]:
    """Title, dates, photographs and what the flight was like."""
    yield "flight", str(given.summary.get("title") or "without a title")
    used = [c for c in given.conditions if c.used]
    yield "date", dates(given.conditions)
    if given.conditions:
        yield "photographs", f"{len(used)} of {len(given.conditions)} used"
    else:
        yield "images", str(given.summary.get("n_images", "not told"))
    yield "aircraft", ", ".join(dict.fromkeys(c.drone for c in given.conditions if c.drone)) or _UNSAID
    flight = given.summary.get("flight")
    for name, said in (flight if isinstance(flight, dict) else {}).items():
        yield str(name), str(said)


def dates(conditions: Sequence[Conditions]) -> str:
    """First and last exposure by the clock of the camera."""
    times = sorted(c.time for c in conditions if c.time)
    if not times:
        return _UNSAID
    zone = "" if len(times[0]) > 19 and times[0][-6] in "+-" else ", by the camera's clock, whose zone it does not say"
    return f"{times[0]} to {times[-1]}{zone}"


def condition_rows(conditions: Sequence[Conditions]) -> Iterator[tuple[str, str]]:
    """Ranges of exposure, aperture, sensitivity, focus and weather over the photographs that were used."""
    told = dict(told_conditions(conditions))
    yield from ((name, told.get(name, _UNSAID)) for name, _, _ in _QUANTITIES)


def told_conditions(conditions: Sequence[Conditions]) -> Iterator[tuple[str, str]]:
    """The same without what the photographs do not say."""
    for name, field, unit in _QUANTITIES:
        values = [v for c in conditions if c.used and (v := getattr(c, field)) is not None]
        if not values:
            continue
        low, middle, high = min(values), float(np.median(values)), max(values)
        said = f"{middle:.4g}" if low == high else f"{low:.4g} to {high:.4g}, median {middle:.4g}"
        yield name, f"{said} {unit}".strip()
