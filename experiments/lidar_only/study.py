"""The third and fourth experiment of paper 000 with lidar heights alone: no signalised point is control.

    python experiments/lidar_only/study.py [OUT] [LAYOUTS]

flies the twin of `recipe.toml` LAYOUTS times (5), gives the tie points the heights of the cloud, calibrates, and prints
standard deviations and correlations beside those that the paper prints; layouts.csv and beside_000.csv go to OUT
(`results`).
"""

import sys
from pathlib import Path

import numpy as np
import pandas as pd

from jaxphoto.block import Block
from jaxphoto.experiment import read_published
from jaxphoto.io import read_recipe
from jaxphoto.lidar import HeightSettings, index_cloud
from jaxphoto.procedures.lidar import lidar_control
from jaxphoto.report import Tables
from jaxphoto.simulation import Simulation, simulate
from jaxphoto.variants import strips

FOLDER = Path(__file__).resolve().parent
IOPS = {"c_mm": "c_mm", "xp_mm": "xp_mm", "yp_mm": "yp_mm", "k1": "k1_mm-2", "k2": "k2_mm-4"}
"""Parameters, as jaxphoto and as the table of the paper name them."""
CORRELATED = {"c_mm": "c", "xp_mm": "xo", "yp_mm": "yo", "k1": "k1", "k2": "k2"}


def conventional(block: Block) -> Block:
    """Two opposite strips without cross strips."""
    return strips(block, ("A", "B"))


EXPERIMENTS = {"third": lambda block: block, "fourth": conventional}


def truth_of(simulation: Simulation) -> dict[str, float]:
    """Return the true interior orientation."""
    camera = simulation.truth.interior["kodak"]
    values = (camera.c, camera.xp, camera.yp, camera.distortion.k1, camera.distortion.k2)
    return dict(zip(IOPS, map(float, values), strict=True))


def layout(seed: int) -> pd.DataFrame:
    """experiment, quantity, value of one flight: errors over sigmas, sigmas, correlations, heights and check points."""
    simulation = simulate(read_recipe(FOLDER / "recipe.toml"), seed)
    grid, truth, rows = index_cloud(simulation.cloud), truth_of(simulation), []
    for name, variant in EXPERIMENTS.items():
        found = lidar_control(variant(simulation.block), grid, "plane", HeightSettings(sigma_z_m=0.15, sigma_xy_m=0.5))
        assert found.converged and set(found.block.control.axis.tolist()) == {2}
        tables = Tables(found.adjusted)
        for one in tables.interior.dropna(subset="sigma").itertuples(index=False):
            rows.append((name, f"error_over_sigma_{one.parameter}", (one.value - truth[one.parameter]) / one.sigma))
            rows.append((name, f"sigma_{IOPS[one.parameter]}", one.sigma))
        of_angles = tables.correlation_summary.query("exterior in ['omega', 'phi', 'kappa']")
        for one in of_angles.itertuples(index=False):
            rows.append((name, f"{one.exterior}/{CORRELATED[one.interior]}", one.mean_abs_rho))
        rows.append((name, "control_heights", float(found.used.sum())))
        rows.append((name, "tie_points", float(len(found.points))))
        off = tables.check_points[["dX_m", "dY_m", "dZ_m"]].to_numpy()
        rows += [(name, f"check_rmse_{a}_m", v) for a, v in zip("XYZ", np.sqrt(np.nanmean(off**2, 0)), strict=True)]
        rows.append((name, "sigma0", float(found.adjusted.sigma0)))
    return pd.DataFrame(rows, columns=["experiment", "quantity", "value"]).assign(layout=seed)


def beside_000(layouts: pd.DataFrame) -> pd.DataFrame:
    """experiment, quantity, lidar_heights (mean over the layouts), signalised_heights (as paper 000 prints)."""
    printed = read_published(FOLDER.parent / "000")
    of_sigmas = printed[printed["table"] == "table2_iops"].set_index(["row", "column"])["published"]
    of_angles = printed[printed["table"] == "table4_mean_abs_correlation"].set_index(["row", "column"])["published"]
    ours = layouts.groupby(["experiment", "quantity"], sort=False)["value"].mean()
    rows = []
    for (experiment, quantity), value in ours.items():
        angle, _, parameter = quantity.partition("/")
        known = (
            of_angles.get((f"{experiment}/{angle}", parameter)) if parameter else of_sigmas.get((experiment, quantity))
        )
        if known is not None:
            rows.append((experiment, quantity, value, known))
    return pd.DataFrame(rows, columns=["experiment", "quantity", "lidar_heights", "signalised_heights"])


def main(out: Path, n: int) -> None:
    """Fly, calibrate, print and write."""
    layouts = pd.concat([layout(seed) for seed in range(1, n + 1)], ignore_index=True)
    beside = beside_000(layouts)
    out.mkdir(parents=True, exist_ok=True)
    layouts.to_csv(out / "layouts.csv", index=False)
    beside.to_csv(out / "beside_000.csv", index=False)
    errors = layouts[layouts["quantity"].str.startswith("error_over_sigma")]
    print(errors.pivot_table(index=["experiment", "quantity"], columns="layout", values="value").round(2).to_string())
    others = layouts[layouts["quantity"].str.startswith(("control", "tie", "check", "sigma0"))]
    print(others.pivot_table(index=["experiment", "quantity"], columns="layout", values="value").round(3).to_string())
    print(beside.to_string(index=False, float_format="{:.4g}".format))


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "results"), int(sys.argv[2]) if len(sys.argv) > 2 else 5)
