"""YAML as every reader gets it: a short text that holds names and values."""

from typing import Any

from jaxphoto.optional import extra

# A camera has some 500 characters; the parser takes seconds for a million.
_LONGEST = 100_000


def yaml_values(text: str) -> dict[str, Any]:
    """The names that are text, and their values. Raises ValueError, saying why, for what cannot be read."""
    if len(text) > _LONGEST:
        raise ValueError(f"{len(text)} characters are no file of cameras; give the one that the program wrote")
    with extra():
        import yaml
    try:
        content = yaml.safe_load(text)
    except (yaml.YAMLError, RecursionError, ValueError, TypeError, AttributeError, KeyError):
        raise ValueError("this is no YAML that can be read; it is cut off or was changed, so write it anew") from None
    if not isinstance(content, dict):
        raise ValueError("it has no names and values; write it anew")
    return {key: value for key, value in content.items() if isinstance(key, str)}
