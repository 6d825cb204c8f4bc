"""JSON as every reader gets it: a file of bounded size and depth that holds names and values."""

import json
from pathlib import Path
from typing import Any

from jaxphoto.errors import InputError
from jaxphoto.io.whole_text import SMALL, read_text


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file. Raises InputError where there is none, and what `read_text` raises."""
    values = read_any_json(path, SMALL)
    if not isinstance(values, dict):
        raise InputError(f"{path} holds no names and values; write it anew")
    return values


def read_any_json(path: Path, most: int) -> Any:
    """What a JSON file of at most `most` bytes holds. Raises InputError where it holds nothing that can be read."""
    try:
        return json.loads(read_text(path, most))
    except RecursionError:
        raise InputError(f"{path} is nested too deeply; write it anew") from None
    except InputError:
        raise
    except ValueError:
        raise InputError(f"{path} is no JSON that can be read; write it anew") from None
