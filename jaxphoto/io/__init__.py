"""Readers and writers of jaxphoto's own files; formats of other programs are in `jaxphoto.extras.formats`."""

from typing import TYPE_CHECKING

from jaxphoto.later import later

if TYPE_CHECKING:
    from jaxphoto.io.block_folder import read_block, write_block
    from jaxphoto.io.camera_files import read_camera_file
    from jaxphoto.io.recipe import read_recipe, recipe_from, truth_tables, write_simulation
    from jaxphoto.io.result_folder import adjusted_block
    from jaxphoto.io.result_tables import read_result_tables, read_truth

__all__ = [
    "adjusted_block", "read_block", "read_camera_file", "read_recipe", "read_result_tables", "read_truth",
    "recipe_from", "truth_tables", "write_block", "write_simulation",
]  # fmt: skip

__getattr__, __dir__ = later(__name__)
