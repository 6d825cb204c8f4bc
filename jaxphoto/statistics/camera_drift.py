"""Did a camera change during its flight: along a straight line of time or temperature, or from strip
to strip? See `zero_test`."""

from typing import NamedTuple

import numpy as np

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import exposures
from jaxphoto.camera import RATES, AbstractCameraRates, StripCamera
from jaxphoto.statistics.covariance import Covariance
from jaxphoto.statistics.zero_test import ZeroTest, zero_test


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


class StripDifferences(NamedTuple):
    """What the cameras of strips have more than the camera of the block (mm); one entry an estimated number."""

    strips: tuple[str, ...]
    parameters: tuple[str, ...]
    """As `StripCamera` names them, without their ends: c, xp, yp."""
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


def strip_differences(adjusted: Adjustment, covariance: Covariance) -> StripDifferences | None:
    """Of all strips whose cameras were estimated; None where none was. Steps from strip to strip are observations."""
    strips, names, labels = [], [], []
    for strip in adjusted.unknowns.more.get(StripCamera.kind, {}):
        for label, name in _estimated(adjusted, StripCamera.kind, strip).items():
            strips.append(strip)
            names.append(name.split("_")[0])
            labels.append(label)
    if not labels:
        return None
    return StripDifferences(tuple(strips), tuple(names), zero_test(adjusted, covariance, labels))


def _estimated(adjusted: Adjustment, kind: str, owner: str) -> dict[str, str]:
    """The names of the estimated parameters of an owner, by their labels."""
    own = f"{kind}[{owner}]."
    return {label: label.removeprefix(own) for label in adjusted.structure.labels if label.startswith(own)}
