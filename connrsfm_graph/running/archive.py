"""Nested dataclasses of arrays as one `.npz`: arrays as they are, all else as JSON, checked against the annotations.

Nothing is pickled. What comes back has the same values bit by bit, arrays in C order, numbers as Python's own; whoever
needs to be independent of whether a value was stored passes it through `packed` and `unpacked` either way.
"""

from __future__ import annotations

import json
import types
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.files import read_npz, written_beside

_JSON = "structure"
T = TypeVar("T")


@dataclass(frozen=True)
class Packed:
    """A dataclass taken apart."""

    structure: str
    """JSON; an array is {"array": its number}."""
    arrays: tuple[np.ndarray, ...]

    def save(self, path: Path) -> None:
        """Write an `.npz`, whole or not at all."""
        named = {str(n): array for n, array in enumerate(self.arrays)}
        text = np.frombuffer(self.structure.encode(), dtype=np.uint8)
        with written_beside(path) as part, part.open("wb") as stream:
            np.savez(stream, allow_pickle=False, **{_JSON: text}, **named)

    @staticmethod
    def load(path: Path) -> Packed:
        """Read what `save` wrote.

        Raises:
            InputError: the file is missing, damaged or of another kind.
        """
        content = read_npz(path)
        if _JSON not in content:
            raise InputError(f"{path}: holds no '{_JSON}', expected a checkpoint")
        text = content.pop(_JSON).tobytes().decode()
        return Packed(text, tuple(content[str(n)] for n in range(len(content))))


def packed(value: Any) -> Packed:
    """Take a dataclass apart.

    Raises:
        TypeError: it holds something that is neither array nor dataclass nor plain.
    """
    arrays: list[np.ndarray] = []
    return Packed(json.dumps(_node(value, arrays)), tuple(arrays))


def unpacked(cls: type[T], pack: Packed) -> T:
    """Put a dataclass together again.

    Raises:
        InputError: the parts are not those of this class.
    """
    try:
        return _value(json.loads(pack.structure), cls, pack.arrays)
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise InputError(f"holds no {cls.__name__} of this version ({error})") from error


def _node(value: Any, arrays: list[np.ndarray]) -> Any:
    if isinstance(value, np.ndarray):
        if value.dtype.hasobject:
            raise TypeError("an array of objects cannot be stored")
        arrays.append(np.asarray(value, order="C"))
        return {"array": len(arrays) - 1}
    if is_dataclass(value):
        return {item.name: _node(getattr(value, item.name), arrays) for item in fields(value)}
    if isinstance(value, Mapping):
        if not all(isinstance(key, str) for key in value):
            raise TypeError("a mapping whose keys are not texts cannot be stored")
        return {key: _node(item, arrays) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_node(item, arrays) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"{type(value).__name__} cannot be stored")


def _value(node: Any, annotation: Any, arrays: tuple[np.ndarray, ...]) -> Any:
    """What a node stands for; TypeError, ValueError, KeyError or IndexError where it does not fit the annotation."""
    origin, inner = get_origin(annotation), get_args(annotation)
    if annotation is Any:
        return _plain(node, arrays)
    if annotation is np.ndarray:
        return arrays[node["array"]]
    if is_dataclass(annotation):
        hints = get_type_hints(annotation)
        names = [item.name for item in fields(annotation)]
        if set(node) != set(names):
            raise ValueError(f"fields of {annotation} differ")
        return annotation(**{name: _value(node[name], hints[name], arrays) for name in names})  # type: ignore[operator]
    if origin in (Union, types.UnionType):
        present = [choice for choice in inner if choice is not types.NoneType]
        if node is None and len(present) < len(inner):
            return None
        (only,) = present
        return _value(node, only, arrays)
    if origin is tuple:
        kinds = (inner[0],) * len(node) if inner[1:] == (...,) else inner
        return tuple(_value(item, kind, arrays) for item, kind in zip(node, kinds, strict=True))
    if origin is list:
        return [_value(item, inner[0], arrays) for item in node]
    if origin is Literal:
        if node not in inner:
            raise ValueError(f"{node} is none of {inner}")
        return node
    if origin is not None and issubclass(dict, origin):
        return {key: _value(item, inner[1], arrays) for key, item in node.items()}
    if isinstance(annotation, type) and issubclass(annotation, tuple):  # a named one
        kinds = tuple(get_type_hints(annotation).values())
        return annotation(*(_value(item, kind, arrays) for item, kind in zip(node, kinds, strict=True)))
    if annotation is float and type(node) is int:
        return float(node)
    if type(node) is not annotation:
        raise TypeError(f"{node!r} is no {annotation}")
    return node


def _plain(node: Any, arrays: tuple[np.ndarray, ...]) -> Any:
    """A value of any type."""
    if isinstance(node, list):
        return [_plain(item, arrays) for item in node]
    if isinstance(node, dict):
        if set(node) == {"array"}:
            return arrays[node["array"]]
        return {key: _plain(item, arrays) for key, item in node.items()}
    return node
