"""Import of a package's names at their first use."""

import ast
import importlib
import pkgutil
import sys
from collections.abc import Callable
from typing import Any


def later(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of a package whose names are imported under its `if TYPE_CHECKING:`.

    The names and submodules are imported at their first use: `import jaxphoto` alone takes half the time.
    """
    module = sys.modules[package]
    source = module.__loader__.get_source(package)  # type: ignore[union-attr]
    checked = (node for block in ast.parse(source).body if isinstance(block, ast.If) for node in block.body)
    sources = {
        name.name: str(node.module) for node in checked if isinstance(node, ast.ImportFrom) for name in node.names
    }
    submodules = {found.name for found in pkgutil.iter_modules(module.__path__)}

    def get(name: str) -> Any:
        if name in sources:
            return getattr(importlib.import_module(sources[name]), name)
        if name in submodules:
            return importlib.import_module(f"{package}.{name}")
        raise AttributeError(f"module {package!r} has no attribute {name!r}")

    def names() -> list[str]:
        return sorted({*module.__all__, *submodules, *(name for name in vars(module) if name.startswith("__"))})

    return get, names
