"""The command `jaxphoto`: options in, library calls, results out.

This package lies beside `jaxphoto` because importing that imports JAX, which takes a second. Help, version and shell
completion need neither: commands import what they need when they run.
"""

# Panels of the help come in this order.
from jaxphoto_command import blocks, photographs, cameras, lidar, files, examples  # noqa: I001
from jaxphoto_command.application import app, command, main, share_one_pool

__all__ = [
    "app", "blocks", "cameras", "command", "examples", "files", "lidar", "main", "photographs", "share_one_pool"
]  # fmt: skip
