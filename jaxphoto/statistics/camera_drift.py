"""Did a camera change during its flight: along a straight line of time, or from strip to strip? See `zero_test`."""

from typing import NamedTuple

import numpy as np

from jaxphoto.adjustment import Adjustment
from jaxphoto.block import exposures
from jaxphoto.camera import CameraRates, StripCamera
from jaxphoto.camera.camera_rates import HOUR_S
from jaxphoto.statistics.covariance import Covariance
from jaxphoto.statistics.zero_test import ZeroTest, zero_test


class CameraDrift(NamedTuple):
    """How one camera changed from its first exposure to its last (mm; K1 in its unit); one entry a rate."""

    camera: str
    hours: float
    parameters: tuple[str, ...]
    """As `CameraRates` names them, without their ends: c, xp, yp, k1."""
    change: ZeroTest


class StripDifferences(NamedTuple):
    """What the cameras of strips have more than the camera of the block (mm); one entry an estimated number."""

    strips: tuple[str, ...]
    parameters: tuple[str, ...]
    """As `StripCamera` names them, without their ends: c, xp, yp."""
    more: ZeroTest


def camera_drifts(adjusted: Adjustment, covariance: Covariance) -> list[CameraDrift]:
    """Of every camera with estimated rates."""
    found, times = [], np.asarray(exposures(adjusted.block).in_flight)
    cameras = np.array(adjusted.block.image_camera)
    for camera in adjusted.unknowns.more.get(CameraRates.kind, {}):
        estimated = _estimated(adjusted, CameraRates.kind, camera)
        if estimated:
            hours = float(np.ptp(times[cameras == camera])) / HOUR_S
            names = tuple(name.split("_")[0] for name in estimated.values())
            found.append(CameraDrift(camera, hours, names, zero_test(adjusted, covariance, [*estimated], hours)))
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
