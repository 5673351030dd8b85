"""Dataclasses survive the way to a file and back bit by bit, and nothing else is taken for one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import pytest

from connrsfm_graph.errors import InputError
from connrsfm_graph.others import Guide, Others
from connrsfm_graph.running.archive import Packed, packed, unpacked

from .conftest import Work, assert_same


class Pair(NamedTuple):
    left: float
    right: int


@dataclass(frozen=True)
class Inner:
    array: np.ndarray
    maybe: np.ndarray | None


@dataclass(frozen=True)
class Outer:
    inner: Inner
    absent: Inner | None
    several: tuple[Inner, ...]
    two: tuple[int, str]
    numbers: list[float]
    table: Mapping[str, float]
    anything: dict[str, Any]
    choice: Literal["a", "b"]
    pair: Pair
    flag: bool
    text: str | None


def example() -> Outer:
    inner = Inner(np.array([[1.0, np.nan], [-0.0, np.inf]]), None)
    other = Inner(np.arange(3), np.zeros((0, 2), dtype=bool))
    return Outer(
        inner=inner,
        absent=None,
        several=(inner, other),
        two=(3, "drei"),
        numbers=[0.1, float("nan"), 1e-320],
        table={"x": 1 / 3},
        anything={"list": [1, None, {"deep": True}], "array": np.ones(2)},
        choice="b",
        pair=Pair(0.5, 2),
        flag=True,
        text=None,
    )


def test_every_kind_of_field_comes_back(tmp_path: Path) -> None:
    value = example()
    path = tmp_path / "value.npz"
    packed(value).save(path)
    assert_same(unpacked(Outer, Packed.load(path)), value)
    with np.load(path, allow_pickle=False) as archive:
        assert all(archive[name].dtype.kind in "fiub" for name in archive.files)


def test_numpy_numbers_become_python_numbers_and_arrays_contiguous() -> None:
    value = Inner(np.arange(6.0).reshape(2, 3).T, None)
    assert unpacked(Inner, packed(value)).array.flags.c_contiguous
    assert type(unpacked(Pair, packed(Pair(np.float64(0.1), np.int64(2)))).left) is float


def test_keyframes_and_blocks_come_back(work: Work, tmp_path: Path) -> None:
    for cls, value in ((Guide, work.guide), (Others, work.others[0])):
        packed(value).save(tmp_path / "value.npz")
        assert_same(unpacked(cls, Packed.load(tmp_path / "value.npz")), value)


@pytest.mark.parametrize("value", [Inner(np.array([None]), None), Inner(np.ones(1), lambda: None)])
def test_what_would_need_pickling_is_refused(value: Inner) -> None:
    with pytest.raises(TypeError, match="cannot be stored"):
        packed(value)


def test_another_dataclass_is_refused() -> None:
    with pytest.raises(InputError, match="holds no Inner of this version"):
        unpacked(Inner, packed(example()))
    with pytest.raises(InputError, match="holds no Pair of this version"):
        unpacked(Pair, packed(Pair("text", 1)))  # type: ignore[arg-type]
