"""Paper 004: aerotriangulation with camera stations, with the IOP of a test field or of the block itself."""

import math

from jaxphoto.block import Block
from jaxphoto.experiment import Experiment, Variant, check_points, iops, named, residuals
from jaxphoto.variants import control_only, hold_interior

# Row of the paper's tables: number of control points, variance factor of the system calibration, its IOP.
ROWS = {
    "1": (1, 0.4605, {"c_mm": 35.535, "xp_mm": -0.165, "yp_mm": -0.169, "k1": -7.0483e-5, "k2": 6.3046e-8}),
    "2": (5, 0.4701, {"c_mm": 35.527, "xp_mm": -0.166, "yp_mm": -0.169, "k1": -7.0575e-5, "k2": 6.3309e-8}),
    "3": (8, 0.4933, {"c_mm": 35.534, "xp_mm": -0.165, "yp_mm": -0.170, "k1": -7.0736e-5, "k2": 6.3746e-8}),
    "4": (38, 0.6242, {"c_mm": 35.533, "xp_mm": -0.166, "yp_mm": -0.172, "k1": -7.0924e-5, "k2": 6.4423e-8}),
}
INDEPENDENT = {"c_mm": 35.506, "xp_mm": -0.123, "yp_mm": -0.098, "k1": -7.0631e-5, "k2": 6.5727e-8}
SIGMA_IMAGE_MM = 0.00395


def block_of(row: str, free: bool) -> Variant:
    """Build the block of one row, self-calibrating or with the test-field IOP fixed."""
    n, variance_factor, truth = ROWS[row]

    def change(block: Block) -> Block:
        chosen = control_only(block, [f"T{k + 1}" for k in range(n)])
        return chosen if free else hold_interior(chosen, "kodak", INDEPENDENT)

    noise = {"image_mm": math.sqrt(variance_factor) * SIGMA_IMAGE_MM}
    return Variant(change, {"cameras": {"kodak": {"truth": truth}}, "noise": noise})


variants = {f"{mode}/{row}": block_of(row, mode == "system") for mode in ("independent", "system") for row in ROWS}
variants["test field"] = Variant(file="testfield.toml")

EXPERIMENT = Experiment(
    title="Paper 004: aerotriangulation with camera stations, independent and system calibration",
    paper="004",
    variants=variants,
    tables={
        "table2_independent_calibration": iops({"60": "test field"}),
        "table3_system_calibration_iops": iops({row: f"system/{row}" for row in ROWS}),
        "table4_residuals": residuals(named(v for v in variants if "/" in v), image="px", ground="mm"),
        "table5_checkpoints": check_points(named(v for v in variants if "/" in v)),
    },
    layouts=20,
)
