"""Command `jaxphoto`: reads options, calls the library, reports results.

This package is separate from `jaxphoto` because importing `jaxphoto` imports JAX, which takes a second. Help, version
and shell completion need neither: commands import the library when they run.
"""

# Order of the help panels.
from jaxphoto_command import blocks, photographs, cameras, lidar, files, examples  # noqa: I001
from jaxphoto_command.application import app, command, main, share_one_pool

__all__ = [
    "app", "blocks", "cameras", "command", "examples", "files", "lidar", "main", "photographs", "share_one_pool"
]  # fmt: skip
