"""The [mounts.X] and [strips.X] tables of block.toml: lever arm, boresight, shift and drift."""

from collections.abc import Container, Iterable
from typing import Any

import numpy as np

from jaxphoto.arrays import on_device
from jaxphoto.errors import quoted
from jaxphoto.georeferencing import IMAGE_X, Mount, StripBias
from jaxphoto.io.block_folder.camera_section import status
from jaxphoto.io.block_folder.section import Section

_DEG = np.pi / 180


def read_mounts(section: Section, cameras: Iterable[str]) -> tuple[dict[str, Mount], dict[str, Mount]]:
    """Mounts (start values) and their priors by name: "default" or the id of a camera."""
    section.known("default", *cameras)
    mounts, priors = {}, {}
    for name in section:
        table = section.section(name)
        table.known("lever_arm_m", "boresight_deg", "time_offset_s", "image_x", "lever_arm", "boresight", "time_offset")
        arm, boresight = table.vector("lever_arm_m"), table.vector("boresight_deg") * _DEG
        if np.any(np.abs(arm) > 100):
            raise table.error("lever_arm_m", f"{arm.tolist()} m is no lever arm; give it in metres")
        image_x = table.text("image_x", "forward")
        if image_x not in IMAGE_X:
            raise table.error(
                "image_x", f"{quoted(image_x)} is no direction of the camera's x axis; use {', '.join(IMAGE_X)}"
            )
        offset = table.number("time_offset_s", 0.0)
        mounts[name] = Mount(on_device(arm), on_device(boresight), on_device(offset), image_x)  # type: ignore[arg-type]
        priors[name] = Mount(
            table.prior("lever_arm", arm, "_m"),  # type: ignore[arg-type]
            table.prior("boresight", boresight, "_deg", _DEG),  # type: ignore[arg-type]
            table.prior("time_offset", offset, "_s"),  # type: ignore[arg-type]
            image_x,  # type: ignore[arg-type]
        )
    return mounts, priors


def mounts_of(cameras: Iterable[str], mounts: Container[str]) -> dict[str, str]:
    """The mount of each camera: the one that has its name, else "default", else none ("")."""
    return {name: name if name in mounts else "default" if "default" in mounts else "" for name in cameras}


def read_strips(section: Section, strips: Iterable[str]) -> tuple[dict[str, StripBias], dict[str, StripBias]]:
    """Shift and drift (start values) and their priors of every strip that has a table or the default's."""
    named = tuple(strips)
    if section.values and not named:
        raise section.error("", "images.csv names no strips; add its column strip or remove the tables")
    section.known("default", *named)
    biases, priors = {}, {}
    for strip in named:
        key = strip if strip in section else "default"
        if key not in section:
            continue
        table = section.section(key)
        table.known("shift_m", "drift_m_per_s", "shift", "drift")
        shift, drift = table.vector("shift_m"), table.vector("drift_m_per_s")
        biases[strip] = StripBias(on_device(shift), on_device(drift))
        priors[strip] = StripBias(
            table.prior("shift", shift, "_m"),  # type: ignore[arg-type]
            table.prior("drift", drift, "_m_per_s"),  # type: ignore[arg-type]
        )
    return biases, priors


def mount_section(mount: Mount, prior: Mount) -> dict[str, Any]:
    """The [mounts.X] table that `read_mounts` reads as `mount`."""
    return {
        "lever_arm_m": np.asarray(mount.lever_arm).tolist(),
        "boresight_deg": (np.asarray(mount.boresight) / _DEG).tolist(),
        "time_offset_s": float(mount.time_offset),
        "image_x": mount.image_x,
        "lever_arm": status(prior.lever_arm, mount.lever_arm),
        "boresight": status(prior.boresight, mount.boresight, _DEG),
        "time_offset": status(prior.time_offset, mount.time_offset),
    }


def strip_section(bias: StripBias, prior: StripBias) -> dict[str, Any]:
    """The [strips.X] table that `read_strips` reads as `bias`."""
    return {
        "shift_m": np.asarray(bias.shift).tolist(),
        "drift_m_per_s": np.asarray(bias.drift).tolist(),
        "shift": status(prior.shift, bias.shift),
        "drift": status(prior.drift, bias.drift),
    }
