"""Declarations of camera models, used by readers, writers and tables instead of a list of models."""

import dataclasses
import inspect
from collections.abc import Iterable, Mapping
from typing import ClassVar, TypeVar

import equinox as eqx

from jaxphoto.errors import InputError

Kind = TypeVar("Kind", bound="Declared")


class Declared(eqx.Module):
    """Base class of distortions and projections that files identify by name.

    `name`: name in files and commands. `coefficients`: fields that an adjustment can estimate. `constants`: fields that
    are never estimated, by their names in files, which end in the unit (`{"r0_mm": "r0"}`). `choices`: static fields
    with their possible values. `powers`: unit of each coefficient as a power of mm: -2 for mm^-2, 0 if dimensionless.

    Defining a class registers it; a second definition with the same name replaces the first, as when a notebook cell is
    re-run.
    """

    name: eqx.AbstractClassVar[str]
    coefficients: ClassVar[tuple[str, ...]] = ()
    constants: ClassVar[Mapping[str, str]] = {}
    choices: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    powers: ClassVar[Mapping[str, int]] = {}

    def __init_subclass__(cls, **options) -> None:
        super().__init_subclass__(**options)
        # Skip the temporary subclasses of Equinox, which declare nothing.
        if "name" in cls.__dict__:
            _check(cls)
            of_kind = _KNOWN.setdefault(_kind(cls), {})
            before = of_kind.get(cls.name)
            if before is not None and (before.__module__, before.__qualname__) != (cls.__module__, cls.__qualname__):
                raise InputError(
                    f"{cls.__qualname__}: another class, {before.__module__}.{before.__qualname__}, is called "
                    f"{cls.name!r} already; give it another name"
                )
            of_kind[cls.name] = cls

    @classmethod
    def known(cls: type[Kind]) -> Mapping[str, type[Kind]]:
        """Return all models of this kind by name: models of jaxphoto first, then user-defined models."""
        return dict(_KNOWN.get(cls, {}))

    @classmethod
    def called(cls: type[Kind], name: str) -> type[Kind]:
        """Return the model of this kind by name. Raises InputError if there is none."""
        known = cls.known()
        if name not in known:
            kind = cls.__name__.removeprefix("Abstract").lower()
            raise InputError(f"unknown {kind} model {name!r}; choose one of {', '.join(known)}")
        return known[name]

    @classmethod
    def power(cls, coefficient: str) -> int | None:
        """Return the unit of a coefficient as a power of mm; None if undeclared."""
        return cls.powers.get(coefficient)

    @classmethod
    def needed(cls) -> dict[str, str]:
        """Return the required `constants` (without default), all of them positive lengths."""
        without = {f.name for f in dataclasses.fields(cls) if f.default is dataclasses.MISSING}
        return {name: field for name, field in cls.constants.items() if field in without}


_KNOWN: dict[type, dict[str, type]] = {}


def _kind(cls: type) -> type:
    """Return the direct subclass of `Declared` from which `cls` derives."""
    return next(base for base in cls.__mro__ if Declared in base.__bases__)


def _check(cls: type[Declared]) -> None:
    """Raise InputError if the declarations of a class do not match its fields."""
    fields = {name for base in cls.__mro__ for name in _annotated(base)}
    listed = (*cls.coefficients, *cls.constants.values(), *cls.choices)
    if wrong := [name for name in listed if name not in fields]:
        raise InputError(
            f"{cls.__qualname__}: {', '.join(wrong)} declared, but no such field exists; its fields are "
            f"{_listed(sorted(fields))}"
        )
    if silent := [name for name in _annotated(cls) if name not in listed]:
        raise InputError(
            f"{cls.__qualname__}: the field {', '.join(silent)} is not declared; name it in coefficients, constants "
            "or choices"
        )
    if missing := [name for name in cls.coefficients if cls.power(name) is None]:
        raise InputError(
            f"{cls.__qualname__}: the unit of {', '.join(missing)} is not declared; give its power of mm in powers "
            f'(such as powers = {{"{missing[0]}": -2}} for mm^-2, 0 if dimensionless)'
        )
    if strange := [name for name in cls.powers if name not in cls.coefficients]:
        raise InputError(f"{cls.__qualname__}: {', '.join(strange)} in powers is not a coefficient; correct it")
    if len(set(listed)) < len(listed):
        raise InputError(
            f"{cls.__qualname__}: a field is declared twice; name it once in coefficients, constants or choices"
        )


def _annotated(cls: type) -> list[str]:
    """Return the annotated fields in the body of a class, class variables excluded."""
    hints = inspect.get_annotations(cls)
    return [name for name, hint in hints.items() if "ClassVar" not in str(hint)]


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names) or "none"
