"""What drones write into the XMP packet of a photograph, as far as positions need it.

DJI writes attributes of the namespace `drone-dji`: with a receiver that had corrections (RTK) the standard deviations
RtkStdLon, RtkStdLat, RtkStdHgt in metres, and RtkFlag: 50 fixed, 34 float, 16 single, 0 none (DJI, Phantom 4 RTK User
Manual; the flag's values are those of its MRK files).
"""

import re
from typing import Any

import numpy as np

# Attributes or elements, however the packet is laid out: an XML parser refuses packets that cameras cut off.
_DJI = re.compile(rb"(?<!/)drone-dji:(\w+)\s*(?:=\s*\"([^\"]{0,100})\"|>([^<]{0,100})<)")
# Of a packet, what is looked at; it lies in one segment of 64 kilobytes in a JPEG.
_MOST_BYTES = 1_000_000
_SIGMAS = ("RtkStdLon", "RtkStdLat", "RtkStdHgt")


def dji_fields(packet: Any) -> dict[str, str]:
    """The attributes that DJI writes, by name; none where the packet is absent or another's."""
    if not isinstance(packet, bytes | str):
        return {}
    content = packet.encode("utf-8", "replace") if isinstance(packet, str) else packet
    found = _DJI.findall(content[:_MOST_BYTES])
    return {name.decode(): (given or inner).decode("utf-8", "replace").strip() for name, given, inner in found}


def rtk_sigma(fields: dict[str, str]) -> tuple[float, float, float] | None:
    """Standard deviations (m) of longitude, latitude and height of a receiver with corrections, None without."""
    try:
        sigma = tuple(float(fields[name]) for name in _SIGMAS)
    except (KeyError, ValueError):
        return None
    return sigma if len(sigma) == 3 and all(np.isfinite(sigma)) and min(sigma) > 0 else None
