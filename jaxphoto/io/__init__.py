"""Files -> `Block` and back: the block folder, and other programs' formats converted to it."""

from jaxphoto.io.block_folder import read_block, write_block
from jaxphoto.io.cameras import read_camera_file, write_camera_file
from jaxphoto.io.convert import FORMATS, convert, read_source
from jaxphoto.io.exports import EXPORTS, AdjustedPhotographs, adjusted_block, export
from jaxphoto.io.recipe import read_recipe, read_truth, recipe_from, truth_tables, write_simulation
from jaxphoto.io.result_tables import read_result_tables

__all__ = [
    "EXPORTS", "FORMATS", "AdjustedPhotographs", "adjusted_block", "convert", "export", "read_block",
    "read_camera_file", "read_recipe", "read_result_tables", "read_source", "read_truth", "recipe_from",
    "truth_tables", "write_block", "write_camera_file", "write_simulation",
]  # fmt: skip
