"""Adjusted photographs -> the files of other programs (docs/exports.md)."""

from jaxphoto.io.exports.adjusted_photographs import AdjustedPhotographs, ExportCamera
from jaxphoto.io.exports.formats import EXPORTS, Exported, check_export_target, export
from jaxphoto.io.exports.result_folder import adjusted_block, is_result, photograph_files, write_photograph_files

__all__ = [
    "EXPORTS", "AdjustedPhotographs", "ExportCamera", "Exported", "adjusted_block", "check_export_target", "export",
    "is_result", "photograph_files",
    "write_photograph_files",
]  # fmt: skip
