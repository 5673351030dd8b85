"""Keyframes of a small sequence, and blocks of images that follow them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np
import pytest

from connrsfm_graph.keyframes import KeyframeConfig
from connrsfm_graph.others import Guide, Others
from connrsfm_graph.progress import Progress
from connrsfm_graph.reconstruct import Config, make_guide, reconstruct_jointly
from connrsfm_graph.running.archive import packed, unpacked
from connrsfm_graph.running.block import Block, Finished
from connrsfm_graph.running.crew import Here
from connrsfm_graph.synthetic import isometric_bending, with_missing, with_noise
from connrsfm_graph.tracks import Tracks

FEW = Config(keyframes=KeyframeConfig(most=8))


@dataclass(frozen=True)
class Work:
    """What a crew is given, and what is to come of it."""

    tracks: Tracks
    guide: Guide
    blocks: tuple[Block, ...]
    others: dict[int, Others]
    """By the first image of the block."""


@pytest.fixture(scope="session")
def work() -> Work:
    tracks = with_missing(with_noise(isometric_bending(n_frames=20, n_points=50, smooth=True).tracks, 1.0), 0.1)
    keys = np.linspace(0, 19, 8).round().astype(int)
    part = tracks.select(frames=keys)
    joint = reconstruct_jointly(part, FEW, Progress())
    guide = unpacked(Guide, packed(make_guide(part, joint, FEW)))
    following = tracks.select(frames=np.setdiff1d(np.arange(20), keys))
    image = following.normalised()
    blocks = tuple(Block(n, image[n : n + 2], following.visible[n : n + 2]) for n in range(0, 12, 2))
    return Work(tracks, guide, blocks, {done.first: done.others for done in Here().work(guide, blocks)})


@pytest.fixture(scope="session")
def check(work: Work) -> Callable[[Iterable[Finished]], None]:
    """That every block was worked on once, with the same outcome as here."""

    def checked(answers: Iterable[Finished]) -> None:
        found = {done.first: done.others for done in answers}
        assert sorted(found) == sorted(work.others)
        for first, others in work.others.items():
            assert_same(found[first], others)

    return checked


def assert_same(a: Any, b: Any, where: str = "") -> None:
    """Two nested values are equal, bit by bit."""
    assert type(a) is type(b), where
    if is_dataclass(a):
        for item in fields(a):
            assert_same(getattr(a, item.name), getattr(b, item.name), f"{where}.{item.name}")
    elif isinstance(a, np.ndarray):
        assert a.dtype == b.dtype, where
        np.testing.assert_array_equal(a, b, err_msg=where)
    elif isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for key in a:
            assert_same(a[key], b[key], f"{where}.{key}")
    elif isinstance(a, list | tuple):
        assert len(a) == len(b), where
        for n, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_same(x, y, f"{where}[{n}]")
    else:
        assert a == b or (a != a and b != b), where


def with_settings(**running: Any) -> Config:
    """The settings of these tests, carried out in another way."""
    return replace(FEW, running=replace(FEW.running, **running))
