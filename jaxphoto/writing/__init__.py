"""Writing: files and folders that are there whole or not at all, and that take the place of nothing of the user's."""

from jaxphoto.writing.manifest import MARKER, Clashes, files_in
from jaxphoto.writing.place import clear_leftovers, is_place, locked
from jaxphoto.writing.whole import check_file, check_folder, check_room, whole_file, whole_folder

__all__ = [
    "MARKER", "Clashes", "check_file", "check_folder", "check_room", "clear_leftovers", "files_in",
    "is_place", "locked", "whole_file", "whole_folder",
]  # fmt: skip
