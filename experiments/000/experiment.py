"""Paper 000: in-situ calibration over a cross block, with control in three dimensions or in height only."""

from jaxphoto.block import Block
from jaxphoto.experiment import (
    Experiment,
    Variant,
    check_points,
    iops,
    mean_correlations,
    named,
    orientation_differences,
    residuals,
    tie_point_differences,
)
from jaxphoto.variants import all_control, strips, vertical_control


def conventional(block: Block) -> Block:
    """Two opposite strips without cross strips, heights only."""
    return vertical_control(strips(block, ("A", "B")))


variants = {
    "first": Variant(),
    "second": Variant(all_control),
    "third": Variant(vertical_control),
    "fourth": Variant(conventional),
}
rows = named(variants)
pairs = [("second", other) for other in ("first", "third", "fourth")]

EXPERIMENT = Experiment(
    title="Paper 000: in-situ self-calibration with camera stations, four experiments",
    paper="000",
    variants=variants,
    tables={
        "table2_iops": iops(rows),
        "table3_residuals": residuals(rows),
        "table4_mean_abs_correlation": mean_correlations(
            rows, {"c_mm": "c", "xp_mm": "xo", "yp_mm": "yo", "k1": "k1", "k2": "k2"}
        ),
        "table5_checkpoints": check_points({"first": "first"}),
        "table6_tie_point_differences": tie_point_differences(pairs),
        "table7_angle_differences": orientation_differences(pairs),
    },
    layouts=20,
)
