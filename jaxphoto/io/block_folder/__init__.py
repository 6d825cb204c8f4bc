"""The block folder: one TOML file and CSV tables (docs/block_folder.md)."""

from jaxphoto.io.block_folder.block_reader import BlockTables, assemble, exposure_times, read_block
from jaxphoto.io.block_folder.block_writer import whole_block, write_block

__all__ = [
    "BlockTables",
    "assemble",
    "exposure_times",
    "read_block",
    "whole_block",
    "write_block",
]
