"""Strict, typed loading of TOML into nested frozen dataclasses and NamedTuples.

A key that is misspelt, missing or ill-typed never becomes a default: it raises a `ConfigError`, one line that
names the file, the place in it, what is wrong and what would be right. What a type cannot say, a class says
itself, by a `ValueError` from `__post_init__` (dataclasses only) or from a method `validate()`.

Fields are int (64 bits), float (an integer will do), bool, str, Literal, tuple[X, ...], tuple[X, Y], a
dataclass, a NamedTuple, or `X | None` with the default None, for TOML has no null.
"""

import dataclasses
import difflib
import math
import reprlib
import tomllib
import types
import typing
from collections.abc import Callable, Iterable
from dataclasses import MISSING
from pathlib import Path
from typing import Any, Literal, NamedTuple, NoReturn, TypeVar

from bipedtrack.messages import Refusal

T = TypeVar("T")


class ConfigError(Refusal, ValueError):
    """A configuration that does not fit its classes; the message is one line."""


def load(cls: type[T], path: str | Path, complete: Callable[[dict[str, Any]], dict[str, Any]] | None = None) -> T:
    """The `cls` that the TOML file `path` describes, once `complete` has written out what the file leaves to be inherited.

    Raises ConfigError.
    """
    place = _Place(str(path))
    try:
        text = Path(path).read_bytes().decode("utf-8-sig")
    except OSError as error:
        place.fail(f"cannot be read ({error.strerror or error}); wanted a TOML file")
    except UnicodeDecodeError as error:
        line = error.object.count(b"\n", 0, error.start) + 1
        place.fail(f"line {line} is not UTF-8 (byte 0x{error.object[error.start]:02x}); save it as UTF-8")
    try:
        data = tomllib.loads(text)
    except (ValueError, RecursionError) as error:
        end = f"at line {text.count(chr(10)) + 1}, the end of the file"
        place.fail(f"is not valid TOML: {str(error).replace('at end of document', end)}")
    return from_dict(cls, complete(data) if complete else data, str(path))


def from_dict(cls: type[T], data: dict[str, Any], where: str) -> T:
    """The `cls` that nested dicts and lists describe; `where` names their source. Raises ConfigError."""
    config: T = _convert_table(cls, data, _Place(where))
    return config


def to_dict(config: Any) -> dict[str, Any]:
    """Nested dicts and lists of plain values, without None: what `from_dict` makes an equal config of."""
    values = {name: getattr(config, name) for name in _fields(type(config))}
    return {name: _plain(value) for name, value in values.items() if value is not None}


class _Place(NamedTuple):
    """Where in which file a value stands, as in `stages[1].lessons[0].difficulty`."""

    file: str
    path: str = ""

    def key(self, name: str) -> "_Place":
        name = name if name.replace("-", "_").isidentifier() else repr(name)
        return self._replace(path=f"{self.path}.{name}" if self.path else name)

    def item(self, index: int) -> "_Place":
        return self._replace(path=f"{self.path}[{index}]")

    def fail(self, message: str) -> NoReturn:
        line = ": ".join(part for part in (self.file, self.path, message) if part)
        raise ConfigError(" ".join(line.split())) from None


class _Field(NamedTuple):
    type: Any
    optional: bool  # written `X | None`
    required: bool


def _is_table(kind: Any) -> bool:
    return dataclasses.is_dataclass(kind) or (isinstance(kind, type) and hasattr(kind, "_field_defaults"))


def _fields(cls: Any) -> dict[str, _Field]:
    """The fields of a dataclass or NamedTuple by name, in their order."""
    if dataclasses.is_dataclass(cls):
        init = [field for field in dataclasses.fields(cls) if field.init]
        defaults = {f.name: f.default if f.default_factory is MISSING else f.default_factory for f in init}
    else:
        defaults = {name: cls._field_defaults.get(name, MISSING) for name in cls._fields}
    hints = typing.get_type_hints(cls)
    fields = {}
    for name, default in defaults.items():
        kind, options = hints[name], typing.get_args(hints[name])
        union = typing.get_origin(kind) in (typing.Union, types.UnionType)
        optional = union and type(None) in options
        if optional:
            if len(options) != 2 or (default is not None and default is not MISSING):
                raise TypeError(f"{cls.__name__}.{name}: wanted `X | None` with the default None")
            kind = options[options[0] is type(None)]
        fields[name] = _Field(kind, optional, default is MISSING and not optional)
    return fields


def _convert(kind: Any, value: Any, place: _Place) -> Any:
    if _is_table(kind):
        return _convert_table(kind, value, place)
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple:
        return _convert_tuple(kind, value, place)
    if origin is Literal:
        if not any(type(value) is type(choice) and value == choice for choice in arguments):
            near = _nearest(value, arguments) if isinstance(value, str) else ""
            place.fail(f"{_shown(value)} is not allowed; {near or 'wanted ' + _words(kind)}")
        return value
    if kind not in (bool, int, float, str):
        raise TypeError(f"{place.path}: a field of type {kind} cannot be loaded")
    if type(value) is int and not -(2**63) <= value < 2**63:
        place.fail(f"an integer of {value.bit_length()} bits does not fit; wanted one of 64 bits")
    if kind is float and type(value) is int:
        value = float(value)
    if type(value) is not kind or (kind is float and not math.isfinite(value)):
        place.fail(f"{_shown(value)} does not fit; wanted {_words(kind)}")
    return value


def _convert_table(cls: Any, data: Any, place: _Place) -> Any:
    if not isinstance(data, dict):
        place.fail(f"{_shown(data)} does not fit; wanted {_words(cls)}")
    fields = _fields(cls)
    for name in data:
        if name not in fields:
            right = _nearest(name, fields) or f"wanted {', '.join(fields) or 'none'}"
            place.key(name).fail(f"unknown key; {right}")
    missing = [name for name, field in fields.items() if field.required and name not in data]
    if missing:
        wanted = ", ".join(f"{name} ({_words(fields[name].type)})" for name in missing)
        place.fail(f"missing {'keys' if missing[1:] else 'key'} without a default; wanted {wanted}")
    values = {name: None for name, field in fields.items() if field.optional}
    values |= {name: _convert(fields[name].type, value, place.key(name)) for name, value in data.items()}
    try:
        config = cls(**values)
        if hasattr(config, "validate"):
            config.validate()
    except ValueError as error:
        place.fail(str(error))
    return config


def _convert_tuple(kind: Any, value: Any, place: _Place) -> tuple[Any, ...]:
    if not isinstance(value, list):
        place.fail(f"{_shown(value)} does not fit; wanted {_words(kind)}")
    kinds = typing.get_args(kind)
    if kinds[-1] is Ellipsis:
        kinds = kinds[:1] * len(value)
    if len(kinds) != len(value):
        place.fail(f"{_shown(value)} has the length {len(value)}; wanted {_words(kind)}")
    return tuple(_convert(kinds[i], item, place.item(i)) for i, item in enumerate(value))


def _plain(value: Any) -> Any:
    if _is_table(type(value)):
        return to_dict(value)
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


def _nearest(word: str, names: Iterable[Any]) -> str:
    by_lower = {name.lower(): name for name in names if isinstance(name, str)}
    near = difflib.get_close_matches(word.lower(), by_lower, n=1)
    return f"did you mean {by_lower[near[0]]!r}?" if near else ""


def _shown(value: Any) -> str:
    names = {bool: "boolean", int: "integer", str: "string", list: "list", dict: "table"}
    return f"{reprlib.repr(value)} ({names.get(type(value), type(value).__name__)})"


def _words(kind: Any) -> str:
    """A type in words: "a list of 2 (a finite number, a finite number)"."""
    arguments = typing.get_args(kind)
    if _is_table(kind):
        return f"a table of {', '.join(_fields(kind))}"
    if typing.get_origin(kind) is Literal:
        return f"one of {', '.join(map(repr, arguments))}"
    if typing.get_origin(kind) is tuple and arguments[-1] is Ellipsis:
        return f"a list, each item {_words(arguments[0])}"
    if typing.get_origin(kind) is tuple:
        return f"a list of {len(arguments)} ({', '.join(map(_words, arguments))})"
    words = {bool: "true or false", int: "an integer", float: "a finite number", str: "a string"}
    return words.get(kind, str(kind))
