"""What a part of a camera declares of itself, so that readers, writers and tables need to know no list of models."""

import dataclasses
import inspect
from collections.abc import Iterable, Mapping
from typing import ClassVar, TypeVar

import equinox as eqx

from jaxphoto.errors import InputError

Kind = TypeVar("Kind", bound="Declared")


class Declared(eqx.Module):
    """A model of a kind (a distortion, a projection) that files know by its name.

    `name` is what files and commands call it. `coefficients` names the fields that an adjustment may estimate;
    `constants` those that it never does, by their names in files, which end in the unit (`{"r0_mm": "r0"}`); `choices`
    names static fields, with the words that they may be. `powers` says in which power of mm a coefficient is: -2 of one
    in mm^-2, 0 of one without unit; one that it does not name has an unknown unit in tables.

    A class is known from its definition on: nothing has to be registered, and a cell of a notebook that is run again
    replaces what it defined before.
    """

    name: eqx.AbstractClassVar[str]
    coefficients: ClassVar[tuple[str, ...]] = ()
    constants: ClassVar[Mapping[str, str]] = {}
    choices: ClassVar[Mapping[str, tuple[str, ...]]] = {}
    powers: ClassVar[Mapping[str, int]] = {}

    def __init_subclass__(cls, **options) -> None:
        super().__init_subclass__(**options)
        # Equinox makes subclasses of its own for a moment: they declare nothing.
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
        """Every model of this kind by its name: those of jaxphoto, then those defined elsewhere."""
        return dict(_KNOWN.get(cls, {}))

    @classmethod
    def called(cls: type[Kind], name: str) -> type[Kind]:
        """The model of this kind with that name. Raises InputError where there is none."""
        known = cls.known()
        if name not in known:
            kind = cls.__name__.removeprefix("Abstract").lower()
            raise InputError(f"no {kind} model is called {name!r}; choose one of {', '.join(known)}")
        return known[name]

    @classmethod
    def power(cls, coefficient: str) -> int | None:
        """The power of mm that is the unit of a coefficient; None where the model does not say."""
        return cls.powers.get(coefficient)

    @classmethod
    def needed(cls) -> dict[str, str]:
        """Those of `constants` that have no default: positive lengths without which the model says nothing."""
        without = {f.name for f in dataclasses.fields(cls) if f.default is dataclasses.MISSING}
        return {name: field for name, field in cls.constants.items() if field in without}


_KNOWN: dict[type, dict[str, type]] = {}


def _kind(cls: type) -> type:
    """The abstract class right below `Declared` that `cls` is of."""
    return next(base for base in cls.__mro__ if Declared in base.__bases__)


def _check(cls: type[Declared]) -> None:
    """Raise InputError where what a class declares is not what its fields are."""
    fields = {name for base in cls.__mro__ for name in _annotated(base)}
    listed = (*cls.coefficients, *cls.constants.values(), *cls.choices)
    if wrong := [name for name in listed if name not in fields]:
        raise InputError(
            f"{cls.__qualname__}: {', '.join(wrong)} in what it declares is no field of it; its fields are "
            f"{_listed(sorted(fields))}"
        )
    if silent := [name for name in _annotated(cls) if name not in listed]:
        raise InputError(
            f"{cls.__qualname__}: the field {', '.join(silent)} is declared nowhere; name it in coefficients, in "
            "constants or in choices"
        )
    if strange := [name for name in cls.powers if name not in cls.coefficients]:
        raise InputError(f"{cls.__qualname__}: {', '.join(strange)} in powers is no coefficient of it; correct it")
    if len(set(listed)) < len(listed):
        raise InputError(
            f"{cls.__qualname__}: a field is declared twice; name it in coefficients, in constants or in choices"
        )


def _annotated(cls: type) -> list[str]:
    """The fields that the body of a class gives: what is annotated and belongs to no class variable."""
    hints = inspect.get_annotations(cls)
    return [name for name, hint in hints.items() if "ClassVar" not in str(hint)]


def _listed(names: Iterable[str]) -> str:
    return ", ".join(names) or "none"
