"""Did a camera change during its flight: along a straight line of time or temperature, along a
spline of time, or from strip to strip? See `zero_test`."""

from typing import Any, NamedTuple

import numpy as np

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import exposures
from jaxphoto.camera import RATES, AbstractCameraRates, CameraSpline, StripCamera
from jaxphoto.short_repr import shown
from jaxphoto.statistics.covariance import Covariance
from jaxphoto.statistics.zero_test import ZeroTest, zero_test


@shown
class CameraDrift(NamedTuple):
    """How one camera changed from its first exposure to its last, or from the coldest to the warmest (mm; K1 in its
    unit); one entry a rate."""

    camera: str
    rates: type[AbstractCameraRates]
    span: float
    """From end to end, in the unit of `rates.along`."""
    parameters: tuple[str, ...]
    """As `AbstractCameraRates` names them, without their ends: c, xp, yp, k1."""
    change: ZeroTest


@shown
class CameraDifferences(NamedTuple):
    """What cameras have more than the camera of the block (mm), by strip or by knot; one entry an estimated number."""

    camera: str
    """Whose knots; "" of strips."""
    at: tuple[str, ...]
    """The strip, or the time of the knot from the middle of the flight in minutes."""
    parameters: tuple[str, ...]
    """As `StripCamera` and `CameraSpline` name them, without their ends: c, xp, yp."""
    more: ZeroTest


def camera_drifts(adjusted: Adjustment, covariance: Covariance) -> list[CameraDrift]:
    """Of every camera with estimated rates, those of time first."""
    found, cameras = [], np.array(adjusted.block.image_camera)
    for rates in RATES:
        along = np.asarray(rates.argument(exposures(adjusted.block)))
        for camera in adjusted.unknowns.more.get(rates.kind, {}):
            if estimated := _estimated(adjusted, rates.kind, camera):
                span = float(np.ptp(along[cameras == camera]))
                names = tuple(name.split("_")[0] for name in estimated.values())
                test = zero_test(adjusted, covariance, [*estimated], span)
                found.append(CameraDrift(camera, rates, span, names, test))
    return found


def strip_differences(adjusted: Adjustment, covariance: Covariance) -> CameraDifferences | None:
    """Of all strips whose cameras were estimated; None where none was. Steps from strip to strip are observations."""
    strips, names, labels = [], [], []
    for strip in adjusted.unknowns.more.get(StripCamera.kind, {}):
        for label, name in _estimated(adjusted, StripCamera.kind, strip).items():
            strips.append(strip)
            names.append(name.split("_")[0])
            labels.append(label)
    if not labels:
        return None
    return CameraDifferences("", tuple(strips), tuple(names), zero_test(adjusted, covariance, labels))


def camera_wanderings(adjusted: Adjustment, covariance: Covariance) -> list[CameraDifferences]:
    """Of every camera with an estimated spline."""
    found: list[CameraDifferences] = []
    spline: Any
    for camera, spline in adjusted.unknowns.more.get(CameraSpline.kind, {}).items():
        if estimated := _estimated(adjusted, CameraSpline.kind, camera):
            names, knots, _ = zip(*(name.split("_") for name in estimated.values()), strict=True)
            minutes = tuple(f"{spline.times[int(knot) - 1] / 60:.3g}" for knot in knots)
            found.append(CameraDifferences(camera, minutes, names, zero_test(adjusted, covariance, [*estimated])))
    return found


def _estimated(adjusted: Adjustment, kind: str, owner: str) -> dict[str, str]:
    """The names of the estimated parameters of an owner, by their labels."""
    own = f"{kind}[{owner}]."
    return {label: label.removeprefix(own) for label in adjusted.structure.labels if label.startswith(own)}
