"""What is wrong with a rolling shutter before anything is computed: its unit, and photographs that do not move."""

from collections.abc import Mapping
from typing import Any

from jaxphoto.camera import ImageMotion, RollingShutter
from jaxphoto.errors import BlockError, counted, few
from jaxphoto.io.block_folder.images import Images
from jaxphoto.io.block_folder.table_layout import TOML
from jaxphoto.unknowns import FIXED, Unknowns, Weighted

# No sensor reads its rows faster (ms), and none slower.
_FASTEST_MS, _SLOWEST_MS = 0.5, 1000.0


def check_shutters(images: Images, starts: Unknowns, priors: Unknowns) -> None:
    """Raise BlockError for readouts in another unit than milliseconds, and shutters or motions without the other.

    A readout that is free, or hardly known, may start anywhere below a second.
    """
    shutters: Mapping[str, Any] = starts.more.get(RollingShutter.kind, {})
    known_before: Mapping[str, Any] = priors.more.get(RollingShutter.kind, {})
    motions = starts.more.get(ImageMotion.kind, {})
    for camera, shutter in shutters.items():
        place = f"{TOML}, [unknowns.{RollingShutter.kind}.{camera}]"
        readout, prior = abs(float(shutter.readout)), known_before[camera].readout
        known = prior == FIXED or (isinstance(prior, Weighted) and float(prior.sigma) < _FASTEST_MS)
        if readout > _SLOWEST_MS or (known and 0 < readout < _FASTEST_MS):
            raise BlockError(
                f"{place} readout_ms: {float(shutter.readout):g} ms cannot be; give milliseconds, of most cameras 5 to "
                "100, or 0 where all rows are exposed at once"
            )
        taken = [name for name, own in zip(images.ids, images.cameras, strict=True) if own == camera]
        if missing := [name for name in taken if name not in motions]:
            raise BlockError(
                f"{place}: {counted(len(missing), 'photograph')} of this camera ({few(missing)}) would stand still; "
                f"give velocity_m_per_s of each in [unknowns.{ImageMotion.kind}.IMAGE]"
            )
    if motions and not shutters:
        raise BlockError(
            f"{TOML}, [unknowns.{ImageMotion.kind}]: how photographs move shows only in rows that are read one after "
            f"another; add [unknowns.{RollingShutter.kind}.CAMERA], or remove them"
        )
