"""Paper 002: IOP of a GoPro by targets and by features, with R0 = 0 and 3 mm, and how alike they are (Table 7)."""

from pathlib import Path

import numpy as np

from jaxphoto.camera import (
    InteriorOrientation,
    Sensor,
    Smac,
    get_parameter,
    parameter_names,
    rebalance,
    rebalance_covariance,
)
from jaxphoto.experiment import Cells, Experiment, Measure, Results, Variant, read_published
from jaxphoto.report import Tables
from jaxphoto.stability import METHODS, analyse, image_grid

PUBLISHED = read_published(Path(__file__).parent)
TABLES = {
    "target1": "table3_iops_target1",
    "target2": "table4_iops_target2",
    "indoor": "table5_iops_indoor",
    "uav": "table6_iops_uav",
}
PAIRS = [("target1", "target2"), ("indoor", "uav"), ("target1", "indoor")]
PAIRS += [("target1", "uav"), ("target2", "indoor"), ("target2", "uav")]
RADII = (0, 3)
IOPS = {"c_mm": "c_mm", "xp_mm": "xp_mm", "yp_mm": "yp_mm", "k1": "k1_mm-2", "k2": "k2_mm-4", "k3": "k3_mm-6"}
SENSOR = Sensor(3000, 2250, 0.00155)
GRID = image_grid(SENSOR, 15, 11)


def printed(dataset: str, r0_mm: int) -> InteriorOrientation:
    """Return the printed IOP."""
    cells = PUBLISHED[PUBLISHED["table"] == TABLES[dataset]].set_index(["row", "column"])["published"]
    values = {name: float(cells[f"R0 = {r0_mm}", column]) for name, column in IOPS.items()}
    c, x_p, y_p = (values.pop(name) for name in ("c_mm", "xp_mm", "yp_mm"))
    return InteriorOrientation(c, x_p, y_p, Smac(**values, r0=float(r0_mm)))


def covariance(tables: Tables, r0_mm: int) -> np.ndarray:
    """Return the a posteriori covariance of the twin's IOP, ordered by name, with another R0."""
    ((camera, interior),) = tables.adjusted.unknowns.interior.items()
    full = tables.covariance.of_interior(camera, parameter_names(interior))
    return np.asarray(rebalance_covariance(interior, float(r0_mm), full))


def iops(dataset: str) -> Measure:
    """In each row the other row's set, brought there by the exact map of R0; sigmas are those of the twin."""

    def measure(results: Results) -> Cells:
        cells: Cells = {}
        for here, there in (RADII, RADII[::-1]):
            mapped, row = rebalance(printed(dataset, there), float(here)), f"R0 = {here}"
            sigma = np.sqrt(covariance(results[dataset], here).diagonal())
            for name, column in IOPS.items():
                cells[row, column] = float(get_parameter(mapped, name))
                cells[row, f"sigma_{column}"] = float(sigma[parameter_names(mapped).index(name)])
        return cells

    return measure


def sigma0(results: Results) -> Cells:
    """Square root of the a posteriori variance of an image coordinate, in mm; R0 is no matter of the images."""
    return {
        (name, f"sigma0_R0_{r0}_mm"): float(tables.adjusted.sigma0)
        * float(tables.adjusted.block.image_points.sigma[0, 0])
        for name, tables in results.items()
        for r0 in RADII
    }


def rmse_offset(results: Results) -> Cells:
    """Table 7 from the printed sets: as rot (to compare with the print), by every method, and what chance explains.

    The latter takes the covariances of the twins for those of the printed sets, which are not printed.
    """
    cells: Cells = {}
    for one, other in PAIRS:
        for r0 in RADII:
            known = covariance(results[one], r0), covariance(results[other], r0)
            found = analyse(printed(one, r0), printed(other, r0), GRID, known)
            row, column = f"{one}/{other}", f"rmse_offset_R0_{r0}_mm"
            cells[row, column] = float(found["rot"].offsets.rmse_mm)
            for method in METHODS:
                cells[row, f"{method}_R0_{r0}_mm"] = float(found[method].offsets.rmse_mm)
            uncertainty = found["rot"].uncertainty
            cells[row, f"sigma_R0_{r0}_mm"] = uncertainty.sigma_mm
            cells[row, f"of_one_camera_R0_{r0}_mm"] = uncertainty.expected_of_one_mm
            cells[row, f"p_of_one_camera_R0_{r0}"] = uncertainty.p_value
    return cells


def twin(dataset: str) -> Variant:
    """Simulate a twin with the printed IOP (R0 = 0) as truth and the printed sigma0 as noise."""
    interior = printed(dataset, 0)
    truth = {name: float(get_parameter(interior, name)) for name in IOPS}
    cells = PUBLISHED[PUBLISHED["table"] == "table2_sigma0"].set_index(["row", "column"])["published"]
    noise = float(cells[dataset, "sigma0_R0_0_mm"])
    recipe = {"cameras": {"gopro": {"truth": truth}}, "sigmas": {"image_mm": noise}}
    return Variant(recipe=recipe, file=f"{dataset.rstrip('12')}.toml")


EXPERIMENT = Experiment(
    title="Paper 002: target-based and feature-based calibration of a GoPro, and its stability",
    paper="002",
    variants={dataset: twin(dataset) for dataset in TABLES},
    tables={"table2_sigma0": sigma0}
    | {table: iops(dataset) for dataset, table in TABLES.items()}
    | {"table7_rmse_offset": rmse_offset},
    layouts=1,
)
