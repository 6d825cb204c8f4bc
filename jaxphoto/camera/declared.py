"""Self-description of camera models, so that readers, writers and tables need no list of models."""

import dataclasses
import inspect
from collections.abc import Iterable, Mapping
from typing import ClassVar, TypeVar

import equinox as eqx

from jaxphoto.errors import InputError

Kind = TypeVar("Kind", bound="Declared")


class Declared(eqx.Module):
    """Model of a kind (a distortion, a projection) that files identify by its name.

    `name` is its name in files and commands. `coefficients` names the fields that an adjustment may estimate;
    `constants` those that it never does, by their names in files, which end in the unit (`{"r0_mm": "r0"}`); `choices`
    names static fields, with their possible values. `powers` gives the power of mm of a coefficient: -2 for mm^-2, 0
    for a number without unit; coefficients it does not name have an unknown unit in tables.

    A class is known once defined, without registration; a notebook cell that is run again replaces its previous
    definition.
    """

    name: eqx.AbstractClassVar[str]
    coefficients: ClassVar[tuple[str, ...]] = ()
    constants: ClassVar[Mapping[str, str]] = {}
    choices: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    powers: ClassVar[Mapping[str, int]] = {}

    def __init_subclass__(cls, **options) -> None:
        super().__init_subclass__(**options)
        # Equinox makes temporary subclasses, which declare nothing.
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
        """Return every model of this kind by name: those of jaxphoto, then user-defined ones."""
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
        """Return the power of mm that is the unit of a coefficient; None if undeclared."""
        return cls.powers.get(coefficient)

    @classmethod
    def needed(cls) -> dict[str, str]:
        """Return the `constants` without default: positive lengths that the model needs."""
        without = {f.name for f in dataclasses.fields(cls) if f.default is dataclasses.MISSING}
        return {name: field for name, field in cls.constants.items() if field in without}


_KNOWN: dict[type, dict[str, type]] = {}


def _kind(cls: type) -> type:
    """Return the abstract class right below `Declared` that `cls` derives from."""
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
    if strange := [name for name in cls.powers if name not in cls.coefficients]:
        raise InputError(f"{cls.__qualname__}: {', '.join(strange)} in powers is not a coefficient; correct it")
    if len(set(listed)) < len(listed):
        raise InputError(
            f"{cls.__qualname__}: a field is declared twice; name it once in coefficients, constants or choices"
        )


def _annotated(cls: type) -> list[str]:
    """Return the fields in the body of a class: annotations except class variables."""
    hints = inspect.get_annotations(cls)
    return [name for name, hint in hints.items() if "ClassVar" not in str(hint)]


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names) or "none"
