"""Files -> `Block` and back: the block folder, and other programs' formats converted to it."""

from jaxphoto.io.block_folder import read_block, write_block
from jaxphoto.io.convert import FORMATS, convert, read_source

__all__ = ["FORMATS", "convert", "read_block", "read_source", "write_block"]
