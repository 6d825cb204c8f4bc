"""Tables of TOML and JSON files: read, validated by key or by a pydantic model, and written.

A validation error is one sentence: file, [table] key, problem, cure.
"""

import functools
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, TypeVar

import numpy as np
from pydantic import (
    AllowInfNan,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    Strict,
    StrictStr,
    TypeAdapter,
    ValidationError,
    model_validator,
)

from jaxphoto.arrays import as_jax_array
from jaxphoto.errors import BlockError, InputError, quoted
from jaxphoto.io.text_files import read_text
from jaxphoto.io.text_tables import LARGEST
from jaxphoto.observations import is_covariance
from jaxphoto.unknowns import FIXED, FREE, Prior, Weighted

Number = Annotated[float, Strict(), AllowInfNan(False), Field(ge=-LARGEST, le=LARGEST)]
Positive = Annotated[Number, Field(gt=0)]
NotNegative = Annotated[Number, Field(ge=0)]
Count = Annotated[int, Strict(), Field(gt=0, le=10**9)]
Whole = Annotated[int, Strict(), Field(ge=0, le=10**9)]
Vector = Annotated[list[Number], Field(min_length=3, max_length=3)]
OneOrMore = Annotated[
    list[Number], BeforeValidator(lambda value: value if isinstance(value, list) else [value]), Field(min_length=1)
]
"""One number or a list of numbers."""
M = TypeVar("M", bound="Keys")


class KeyMistake(ValueError):
    """Validation error of a model, in one of its keys; "" for the whole table."""

    def __init__(self, key: str, message: str):
        super().__init__(message)
        self.key = key


class Keys(BaseModel):
    """Keys of a table, and their types."""

    model_config = ConfigDict(frozen=True, arbitrary_types_allowed=True)

    @model_validator(mode="before")
    @classmethod
    def _refuse_unknown_keys(cls, values: Any) -> Any:
        for key in values if isinstance(values, dict) else ():
            if key not in cls.model_fields:
                raise KeyMistake(key, f"unknown key; use {', '.join(cls.model_fields)} or remove it")
        return values


class Section:
    """Table of a file. `file` and `path` (such as cameras.kodak) are used in messages."""

    def __init__(self, file: str, path: str, values: Any):
        self.file, self.path, self.values = file, path, values
        if not isinstance(values, dict):
            raise InputError(f"{file}, {path}: {quoted(values)} is not a table; write it as [{path}]")

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def __iter__(self) -> Iterator[str]:
        return iter(self.values)

    def error(self, key: str, message: str) -> InputError:
        """Return an error about one key, or about the whole table if key is ""."""
        table = f"[{self.path}] " if self.path else ""
        return InputError(f"{self.file}, {table}{key}".rstrip(" ,") + f": {message}")

    def known(self, *keys: str) -> None:
        """Raise InputError for a key that is not in `keys`."""
        for key in self.values:
            if key not in keys:
                raise self.error(key, f"unknown key; use {', '.join(keys)} or remove it")

    def section(self, key: str) -> "Section":
        """Return the subtable `key`; empty if missing."""
        return Section(self.file, f"{self.path}.{key}" if self.path else key, self.values.get(key, {}))

    def model(self, kind: type[M]) -> M:
        """Validate the table as a model."""
        return self._validated(kind.model_validate, self.values)

    def number(self, key: str, default: float | None = None) -> float:
        """Return a finite number."""
        return self._value(_NUMBER, key, default)

    def positive(self, key: str) -> float:
        """Return a finite number above zero."""
        return self._value(_POSITIVE, key)

    def count(self, key: str) -> int:
        """Return a whole number above zero."""
        return self._value(_COUNT, key)

    def text(self, key: str, default: str | None = None) -> str:
        """Return a text."""
        return self._value(_TEXT, key, default)

    def vector(self, key: str, size: int = 3) -> np.ndarray:
        """Return a vector of finite numbers; zeros if the key is missing."""
        return np.array(self._value(_vector(size), key, [0.0] * size), float)

    def prior(self, key: str, start: Any, unit: str = "", scale: float = 1.0) -> Prior | Weighted:
        """Read a prior: `"free"`, `"fixed"` (the default) or `{ sigma = ..., value = ... }`.

        `value` defaults to `start`. A vector may have `covariance`, the rows of a matrix, instead of `sigma`. `start`
        is in the unit of jaxphoto: the value in the file times `scale`. `unit` is an optional suffix of the keys
        (sigma_deg).
        """
        status = self.values.get(key, "fixed")
        if status in ("free", "fixed"):
            return FREE if status == "free" else FIXED
        given = {name.removesuffix(unit): value for name, value in status.items()} if isinstance(status, dict) else {}
        weights = {"sigma", "covariance"} if np.shape(start) else {"sigma"}
        if len(weights & set(given)) != 1 or set(given) - weights - {"value"}:
            raise self.error(key, f'{quoted(status)} is not a status; write "free", "fixed" or {{ sigma{unit} = ... }}')
        value = self._numbers(key, given["value"], np.shape(start)) * scale if "value" in given else np.asarray(start)
        if "covariance" in given:
            matrix = self.covariance(key, given["covariance"], len(start))
            return Weighted(as_jax_array(value), covariance=as_jax_array(matrix * scale**2))
        sigma = self._numbers(key, given["sigma"], np.shape(start)) * scale
        if not np.all(sigma > 0):
            raise self.error(key, f'sigma = {given["sigma"]} is not positive; correct it, or write "fixed"')
        return Weighted(as_jax_array(value), as_jax_array(sigma))

    def covariance(self, key: str, rows: Any, size: int) -> np.ndarray:
        """Return the covariance matrix (`size` x `size`) with these rows."""
        if not isinstance(rows, list) or [len(r) if isinstance(r, list) else 0 for r in rows] != [size] * size:
            raise self.error(
                key, f"the covariance is not a {size} x {size} matrix; write {size} lists of {size} numbers"
            )
        matrix = np.array([self._numbers(key, row, (size,)) for row in rows])
        if not np.array_equal(matrix, matrix.T) or not is_covariance(matrix):
            raise self.error(key, "the covariance is not symmetric and positive definite; correct it, or give sigma")
        return matrix

    def _numbers(self, key: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
        numbers = np.array(self._validated(_ONE_OR_MORE.validate_python, value, key), float)
        if len(numbers) not in (1, *shape):
            raise self.error(key, f"{quoted(value)} has {len(numbers)} numbers; give one, or one per axis")
        return np.broadcast_to(numbers, shape).copy() if shape else numbers.reshape(())

    def _value(self, adapter: TypeAdapter, key: str, default: Any = None) -> Any:
        if key not in self.values:
            if default is None:
                raise self.error(key, _SENTENCES["missing"])
            return default
        return self._validated(adapter.validate_python, self.values[key], key)

    def _validated(self, validate: Any, values: Any, *key: str) -> Any:
        try:
            return validate(values)
        except ValidationError as errors:
            raise self._sentence(errors, key) from None

    def _sentence(self, errors: ValidationError, key: tuple[str, ...]) -> InputError:
        """Return pydantic's first error, with its location and cure."""
        error = errors.errors()[0]
        mistake = error.get("ctx", {}).get("error")
        place: list[Any] = [*key, *error["loc"], *([mistake.key] if isinstance(mistake, KeyMistake) else [])]
        while place and isinstance(place[-1], int):
            place.pop()
        path = self.path
        for part in place[:-1]:
            path += f", number {part + 1}" if isinstance(part, int) else f".{part}" if path else part
        name = place[-1] if place else ""
        context = {
            "input": quoted(error["input"]),
            "msg": error["msg"],
            "table": f"{path}.{name}" if path else name,
            **error.get("ctx", {}),
        }
        if "expected" in context:
            context["expected"] = context["expected"].replace("'", '"')
        sentence = str(mistake) if mistake else _SENTENCES.get(error["type"], "{input} is not valid: {msg}")
        return Section(self.file, path, {}).error(name, sentence if mistake else sentence.format(**context))


_NUMBER, _POSITIVE, _COUNT = TypeAdapter(Number), TypeAdapter(Positive), TypeAdapter(Count)
_TEXT, _ONE_OR_MORE = TypeAdapter(StrictStr), TypeAdapter(OneOrMore)
_WHOLE = "{input} is not a whole number; give one"
_FINITE = "{input} is not a finite number; write it like 12.34, without quotation marks"
_TABLE = "{input} is not a table; write it as [{table}]"
_SENTENCES = {
    "missing": "the key is missing; add it",
    "float_type": _FINITE,
    "finite_number": _FINITE,
    "int_type": _WHOLE,
    "int_from_float": _WHOLE,
    "greater_than": "{input} is not positive; correct it",
    "greater_than_equal": "{input} is less than {ge:g}; correct it",
    "less_than": "{input} is not below {lt:g}; correct it",
    "less_than_equal": "{input} exceeds the maximum {le:g}; correct it",
    "too_short": "{input} has {actual_length} entries; give {min_length}",
    "too_long": "{input} has {actual_length} entries; give {max_length}",
    "bool_type": "{input} is neither true nor false; write one of them",
    "string_type": '{input} is not text; put it in quotation marks, like "..."',
    "literal_error": "{input} is unknown; write {expected}",
    "list_type": "{input} is not a list; write numbers like [0.0, 0.0], tables as [[{table}]]",
    "dict_type": _TABLE,
    "model_type": _TABLE,
}


@functools.cache
def _vector(size: int) -> TypeAdapter:
    return TypeAdapter(Annotated[list[Number], Field(min_length=size, max_length=size)])


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file. Raises InputError with the line of a syntax error."""
    text = read_text(path)
    try:
        return tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path.name}: {error}; correct the TOML there") from None


def toml_text(values: dict[str, Any]) -> str:
    """Write nested tables as TOML; floats are restored exactly on reading."""
    return "\n".join(_table_lines("", values)).lstrip("\n") + "\n"


def status(prior: Any, start: Any, scale: float = 1.0) -> str | dict[str, Any]:
    """Return the status from which `Section.prior` restores `prior` of an unknown with initial value `start`."""
    if isinstance(prior, Prior):
        return prior.name.lower()
    if not isinstance(prior, Weighted):
        raise BlockError(f"{prior!r} is not a prior; use FREE, FIXED or Weighted(value, sigma)")
    if prior.covariance is None:
        written: dict[str, Any] = {"sigma": (np.asarray(prior.sigma) / scale).tolist()}
    else:
        written = {"covariance": (np.asarray(prior.covariance) / scale**2).tolist()}
    if not np.array_equal(np.asarray(prior.value), np.asarray(start)):
        written["value"] = (np.asarray(prior.value) / scale).tolist()
    return written


def _table_lines(path: str, values: dict[str, Any]) -> list[str]:
    # Only weighted priors are written as inline tables.
    tables = {k: v for k, v in values.items() if isinstance(v, dict) and not {"sigma", "covariance"} & set(v)}
    lines = [f"{_key(k)} = {_value(v)}" for k, v in values.items() if k not in tables]
    if path and lines:
        lines = ["", f"[{path}]", *lines]
    for key, table in tables.items():
        lines += _table_lines(f"{path}.{_key(key)}" if path else _key(key), table)
    return lines


def _key(key: str) -> str:
    bare = key.isascii() and key.replace("-", "").replace("_", "").isalnum()
    return key if bare else _value(key)


def _value(value: Any) -> str:
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(k)} = {_value(v)}" for k, v in value.items()) + " }"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return "[" + ", ".join(map(_value, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        escaped = {c: f"\\u{ord(c):04x}" for c in value if ord(c) < 32 or ord(c) == 127} | {'"': '\\"', "\\": "\\\\"}
        return '"' + "".join(escaped.get(c, c) for c in value) + '"'
    return repr(float(value)) if isinstance(value, float | np.floating) else str(value)
