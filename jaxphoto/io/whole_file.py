"""One file written whole or not at all."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A place to write to, which becomes `path` when all is written, and is removed on an error."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # A folder, because some formats write more than one file and tell themselves by the end of the name.
    with tempfile.TemporaryDirectory(prefix=f".{path.name}-", dir=path.parent) as folder:
        work = Path(folder) / path.name
        yield work
        work.replace(path)
