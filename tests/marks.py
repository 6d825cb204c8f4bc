"""Which cases of a parametrised test are left to `pytest -m slow`."""

from collections.abc import Callable, Iterable
from typing import Any

import pytest


def slow_but(quick: Callable[[Any], bool] | Iterable, cases: Iterable) -> list:
    """`cases`, those that are not `quick` marked slow: what one case shows the others show again."""
    chosen = quick if callable(quick) else set(quick).__contains__
    return [case if chosen(case) else pytest.param(case, marks=pytest.mark.slow) for case in cases]


# `-m quick`: of every room of the package tests that compile little, and one adjustment that the others share.
QUICK = {
    "adjustment": (
        "adjustment/test_bad_input.py",
        "adjustment/test_rays.py::test_rays_and_pairs_are_listed_once",
        "adjustment/test_rays.py::test_rows_lie_where_they_are_computed_with",
        "adjustment/test_outcome.py::test_truth_is_recovered[cross]",
    ),
    "arrays": ("lidar/test_grid.py",),
    "block": ("io/test_bad_blocks.py",),
    "block_edits": ("test_block_edits.py::test_what_a_block_does_not_have_is_named",),
    "block_from_arrays": ("test_block_from_arrays.py",),
    "block_parts": ("io/test_bad_blocks.py",),
    "least_squares": ("test_least_squares.py",),
    "losses": ("test_losses.py",),
    "camera": ("camera/test_additional_parameters.py", "camera/test_balance.py", "camera/test_principal_points.py"),
    "jaxphoto_command": (
        "test_cli.py::test_version_and_help",
        "test_cli.py::test_bad_input_is_one_sentence_and_nothing_written",
    ),
    "cloud": ("lidar/test_roofs.py",),
    "columns": ("test_block_from_arrays.py",),
    "workers": ("test_workers.py::test_only_encrypted_or_local_schedulers_are_used",),
    "collinearity": ("georeferencing/test_direct.py",),
    "compiling": (
        "test_compiling.py::test_a_damaged_file_is_written_anew",
        "test_compiling.py::test_what_differs_is_described_differently",
    ),
    "devices": ("adjustment/test_shards.py::test_as_many_devices_of_each_process",),
    "errors": ("io/test_cameras.py",),
    "experiment": ("experiment/test_docs.py", "experiment/test_page.py"),
    "extras": ("photos/test_features.py",),
    "georeferencing": ("georeferencing/test_corrections.py", "georeferencing/test_map_frame.py"),
    "io": ("io/test_read_block.py", "io/test_write_block.py"),
    "later": ("test_front_door.py::test_everything_can_be_found_by_tab",),
    "lidar": ("lidar/test_planes.py",),
    "observations": ("adjustment/test_structure.py",),
    "parameters": ("adjustment/test_structure.py",),
    "initial": (
        "initial/test_averaging.py",
        "initial/test_intersection.py",
        "initial/test_resection.py",
    ),
    "procedures": ("procedures/test_orient_parts.py",),
    "rounding": ("test_rounding.py",),
    "report": (
        "report/test_culprits.py::test_blunders_are_named_the_largest_first",
        "report/test_plots.py::test_ellipses_are_where_the_quadratic_form_is_one",
        "report/test_plots.py::test_check_points_are_drawn_as_they_are_in_one_scale",
    ),
    "rotation": ("georeferencing/test_lever_arm.py",),
    "sensitivity": (
        "sensitivity/test_network_search.py::test_a_budget_without_stations_and_control_leaves_no_datum",
        "sensitivity/test_network_search.py::test_what_cannot_be_searched_is_said_in_a_sentence",
        "sensitivity/test_network_search.py::test_grid_and_random_designs_fill_the_region",
    ),
    "optional": ("test_lean.py::test_every_extra_is_declared_and_documented",),
    "short_repr": ("test_front_door.py",),
    "argument_checks": ("test_front_door.py",),
    "simulation": (
        "simulation/test_flight_plan.py",
        "simulation/test_recipes.py",
        "simulation/test_scene.py::test_plane_and_waves_of_a_recipe",
        "simulation/test_scene.py::test_rolling_country_is_the_formula_of_the_twins",
    ),
    "linear_algebra": ("test_linear_algebra.py::test_elimination_pivots",),
    "small_matrices": ("adjustment/test_outcome.py::test_truth_is_recovered[cross]",),
    "static_values": ("test_transformations.py::test_a_static_array_is_an_array",),
    "stability": ("test_stability.py::test_equal_weights_give_the_chi_square_distribution_far_into_its_tails",),
    "statistics": (
        "statistics/test_covariance.py::test_kinds_of_rotation_are_one_covariance",
        "statistics/test_significance.py::test_chi_square",
    ),
    "tracing": ("test_transformations.py::test_what_cannot_be_traced_says_so",),
    "unknowns": ("io/test_surfaces.py",),
    "writing": ("test_writing.py",),
    "variants": ("test_variants.py::test_control_only_keeps_the_points_named",),
}
