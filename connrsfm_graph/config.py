"""Configuration: nested frozen dataclasses read from TOML, overridden by `stage.field=value`, and written out resolved.

Nothing here knows a stage. A setting is a field of a dataclass: its annotation is its type (bool, int, float, str,
`Literal`, `tuple[...]`, `... | None` or another dataclass), its default the default, and the string below it its help.
TOML has no null, so None is written "none".
"""

from __future__ import annotations

import ast
import difflib
import inspect
import json
import math
import textwrap
import tomllib
import types
from collections.abc import Iterable, Mapping
from dataclasses import fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from connrsfm_graph.errors import InputError
from connrsfm_graph.files import require_file

C = TypeVar("C")


def read_toml(config: C, path: str | Path) -> C:
    """`config` with the settings of a TOML file in place of its own.

    Raises:
        InputError: no such file, not TOML, an unknown key or a value of the wrong type.
    """
    path = Path(path)
    require_file(path)
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path}: not a TOML file ({error})") from error
    return updated(config, content, source=f"{path}: ")


def override(config: C, assignments: Iterable[str]) -> C:
    """`config` after assignments such as `refine.iterations=50`, from left to right.

    Raises:
        InputError: no equals sign, an unknown key or a value of the wrong type.
    """
    for assignment in assignments:
        key, equals, text = assignment.partition("=")
        if not equals:
            raise InputError(f"--set {assignment}: expected key=value, for example --set {key}=1")
        nested: Any = _Text(text.strip())
        for name in reversed(key.strip().split(".")):
            nested = {name: nested}
        config = updated(config, nested, source="--set ")
    return config


def updated(config: C, values: Mapping[str, Any], source: str = "", prefix: str = "") -> C:
    """`config` with nested `values` in place of its own, each checked against its field's annotation.

    Args:
        config: a dataclass instance.
        values: field name to value; a mapping where the field is a dataclass.
        source: where the values come from, the start of messages.
        prefix: dotted path of `config` in the whole, for messages.

    Raises:
        InputError: an unknown key (the message names the nearest one) or a value of the wrong type.
    """
    hints = _hints(type(config))
    changes: dict[str, Any] = {}
    for name, value in values.items():
        key = f"{prefix}{name}"
        if name not in hints:
            raise InputError(f"{source}{key}: no such setting{_nearest(name, hints, prefix)}")
        current = getattr(config, name)
        if not is_dataclass(current):
            changes[name] = _converted(value, hints[name], f"{source}{key}")
        elif isinstance(value, Mapping):
            changes[name] = updated(current, value, source, f"{key}.")
        else:
            inner = ", ".join(f"{key}.{item.name}" for item in fields(current))
            raise InputError(f"{source}{key}: is a group of settings; set one of {inner}")
    try:
        return replace(config, **changes)  # type: ignore[type-var]
    except InputError as error:
        raise InputError(f"{source}{error}") from error
    except ValueError as error:
        raise InputError(f"{source}{prefix.rstrip('.') or 'configuration'}: {error}") from error


def as_dict(config: Any) -> dict[str, Any]:
    """The configuration as nested dictionaries of plain values."""
    values = {item.name: getattr(config, item.name) for item in fields(config)}
    return {name: as_dict(value) if is_dataclass(value) else value for name, value in values.items()}


def as_toml(config: Any) -> str:
    """The configuration as TOML text with each setting's help above it; `read_toml` gives the same configuration."""
    return "\n\n".join(_toml_table(config, "")).strip() + "\n"


def setting_help(cls: type) -> dict[str, str]:
    """The docstring under each field of a dataclass, by field name; absent where it has none or its source is gone."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        if not is_dataclass(base):
            continue
        try:
            source = inspect.getsource(base)
        except OSError:  # defined interactively, or shipped without source
            continue
        body = ast.parse(textwrap.dedent(source)).body[0]
        assert isinstance(body, ast.ClassDef)
        for item, text in zip(body.body, body.body[1:], strict=False):
            if not (isinstance(item, ast.AnnAssign) and isinstance(item.target, ast.Name)):
                continue
            if isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
                found[item.target.id] = inspect.cleandoc(str(text.value.value))
    return found


class _Text(str):
    """A value as typed on the command line, whose type its field decides."""


def _hints(cls: type) -> dict[str, Any]:
    hints = get_type_hints(cls)
    return {item.name: hints[item.name] for item in fields(cls)}


def _nearest(name: str, known: Iterable[str], prefix: str) -> str:
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    if near:
        return f"; did you mean {prefix}{near[0]}?"
    return "; expected one of " + ", ".join(f"{prefix}{candidate}" for candidate in known)


def _converted(value: Any, annotation: Any, key: str) -> Any:
    """`value` as the annotation wants it, or an `InputError` that says what was expected."""
    try:
        return _as(value, annotation)
    except (TypeError, ValueError):
        shown = str(value) if isinstance(value, _Text) else repr(value)
        raise InputError(f"{key}: {shown} is not {_described(annotation)}") from None


def _as(value: Any, annotation: Any) -> Any:
    """`value` as the annotation wants it; TypeError or ValueError where it does not fit."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin in (Union, types.UnionType):
        return _first_that_fits(value, inner)
    if annotation is types.NoneType:
        if value is None or (isinstance(value, str) and value.lower() == "none"):
            return None
        raise ValueError
    if isinstance(value, _Text):
        value = _from_text(value, origin or annotation, inner)
    if origin is Literal:
        if not any(type(value) is type(choice) and value == choice for choice in inner):
            raise ValueError
        return value
    if origin is tuple:
        return _as_tuple(value, inner)
    if annotation is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not annotation:
        raise TypeError
    if annotation is float and math.isnan(value):
        raise ValueError
    return value


def _first_that_fits(value: Any, candidates: tuple[Any, ...]) -> Any:
    # None first, so that "none" is not taken for a string.
    for candidate in sorted(candidates, key=lambda candidate: candidate is not types.NoneType):
        try:
            return _as(value, candidate)
        except (TypeError, ValueError):
            continue
    raise ValueError


def _as_tuple(value: Any, inner: tuple[Any, ...]) -> tuple[Any, ...]:
    if not isinstance(value, list | tuple):
        raise TypeError
    if inner[1:] == (...,):
        inner = (inner[0],) * len(value)
    return tuple(_as(item, kind) for item, kind in zip(value, inner, strict=True))


def _from_text(text: _Text, kind: Any, inner: tuple[Any, ...]) -> Any:
    """A TOML value, or the text itself where a string is wanted or nothing else can be read."""
    plain = str(text)
    if kind is bool and plain.lower() in ("true", "false"):
        return plain.lower() == "true"
    if kind is tuple and not plain.startswith("["):
        plain = f"[{plain}]"
    try:
        value = tomllib.loads(f"value = {plain}")["value"]
    except tomllib.TOMLDecodeError:
        return plain
    wants_string = kind is str or (kind is Literal and all(isinstance(choice, str) for choice in inner))
    return plain if wants_string and not isinstance(value, str) else value


def _described(annotation: Any) -> str:
    """An annotation in words, with its article."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin in (Union, types.UnionType):
        return " or ".join(_described(item) for item in inner)
    if origin is Literal:
        return "one of " + ", ".join(str(choice) for choice in inner)
    if origin is tuple:
        if inner[1:] == (...,):
            return f"a list of which each is {_described(inner[0])}"
        return f"a list of {len(inner)} ({', '.join(_described(item) for item in inner)})"
    words = {bool: "true or false", int: "a whole number", float: "a number", str: "a text", types.NoneType: "none"}
    return words.get(annotation, str(annotation))


def _toml_table(config: Any, path: str) -> list[str]:
    """One block of TOML text for this dataclass and one for every dataclass below it."""
    described = setting_help(type(config))
    lines = [f"[{path}]"] if path else []
    below: list[str] = []
    for item in fields(config):
        value = getattr(config, item.name)
        if is_dataclass(value):
            below += _toml_table(value, f"{path}.{item.name}" if path else item.name)
            continue
        comment = described.get(item.name, "")
        lines += [f"# {line}".rstrip() for line in textwrap.wrap(comment, 110)]
        lines.append(f"{item.name} = {_toml_value(value)}")
    return (["\n".join(lines)] if lines else []) + below


def _toml_value(value: Any) -> str:
    if value is None:
        return '"none"'
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        # JSON's string is TOML's, but for the delete character.
        return json.dumps(value, ensure_ascii=False).replace("\x7f", "\\u007f")
    if isinstance(value, tuple):
        return f"[{', '.join(_toml_value(item) for item in value)}]"
    return repr(value)
