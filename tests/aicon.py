"""The project of AICON whose report the tests reproduce: .ior, .phc, .eor, .obc and .scale, lengths in mm.

object_from_camera is Rx(omega) Ry(phi) Rz(kappa); the distortion is `Balanced`; c has the opposite sign.
Source: github.com/applied-geodesy/bundle-adjustment, which reads these files.
"""

from pathlib import Path

import numpy as np
import pandas as pd

from jaxphoto.block import Block
from jaxphoto.io.block_folder import BlockTables, assemble
from jaxphoto.io.text_tables import Table

XYZ, FREE = ("X_m", "Y_m", "Z_m"), ("c_mm", "xp_mm", "yp_mm", "a1", "a2", "b1", "b2")
IDS = {0: str, 1: str}


def read_aicon(folder: Path) -> Block:
    """Read the block: image points with all flags 1 and a point in .obc, 0.5 um; inner datum, scaled by the bar."""
    ior, phc, eor, obc, scale = (
        pd.read_csv(next(folder.glob(f"*.{end}")), sep=r"\s+", header=None, comment="#", names=range(11), dtype=kinds)
        for end, kinds in (("ior", None), ("phc", IDS), ("eor", IDS), ("obc", {0: str}), ("scale", None))
    )
    values = ior.to_numpy()
    c, xp, yp, a1, a2, r0 = values[0, 2:8].tolist()
    a3, (b1, b2), (c1, c2), (width_mm, height_mm, width, height) = (
        float(values[1, 0]), *(values[k, :2].astype(float) for k in (2, 3)), values[4, :4].astype(float)
    )  # fmt: skip
    interior = {"c_mm": -c, "xp_mm": xp, "yp_mm": yp, "a1": a1, "a2": a2, "a3": a3, "b1": b1, "b2": b2, "c1": c1,
                "c2": c2, "r0_mm": r0}  # fmt: skip
    camera = {
        "width_px": int(width), "height_px": int(height), "pixel_mm": (width_mm / width + height_mm / height) / 2,
        "distortion": "balanced", "interior": {key: float(value) for key, value in interior.items()},
        "unknowns": dict.fromkeys(FREE, "free"),
    }  # fmt: skip
    phc = phc[(phc[[8, 9, 10]] == 1).all(axis=1) & phc[1].isin(obc[0])]
    obc, bars = obc[obc[0].isin(phc[1])], scale[scale[6] == 1]
    text = lambda column: column.astype(str).to_numpy(object)  # noqa: E731
    metres = lambda table, first: dict(zip(XYZ, table[[first, first + 1, first + 2]].to_numpy().T / 1000, strict=True))  # noqa: E731
    angles = np.rad2deg(eor[[5, 6, 7]].to_numpy(float).T)
    tables = {
        "images": {"image": text(eor[0]), "camera": text(eor[1])} | metres(eor, 2)
        | dict(zip(("omega_deg", "phi_deg", "kappa_deg"), angles, strict=True)),
        "image_points": {"image": text(phc[0]), "point": text(phc[1])}
        | {"x_mm": phc[2].to_numpy(float), "y_mm": phc[3].to_numpy(float)},
        "object_points": {"point": text(obc[0])} | metres(obc, 1),
        "distances": {"point_a": text(bars[2]), "point_b": text(bars[3])}
        | {"distance_m": bars[4].to_numpy(float) / 1000, "sigma_m": bars[5].to_numpy(float) / 1000},
    }  # fmt: skip
    settings = {"title": "example", "sigmas": {"image_mm": 0.0005}, "cameras": {eor[1][0]: camera},
                "datum": {"kind": "inner", "over": "points", "scale": False}}  # fmt: skip
    return assemble(BlockTables(settings, {name: Table.of("aicon", table) for name, table in tables.items()}, "aicon"))
