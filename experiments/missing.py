"""Missing data: a share of all observations removed at random, on synthetic data set 1."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial

from connrsfm_graph.synthetic import with_missing
from connrsfm_graph.synthetic.scene import Scene
from connrsfm_graph.tracks import Tracks
from experiments.study import VARIANTS, Case, Experiment, Options
from experiments.synthetic import data_set_1, tracks_of

SHARES = (0, 30, 50, 70)
"""Percent of the observations that are removed."""


def _tracks(scene: Callable[..., Scene], share: int, seed: int) -> Tracks:
    return with_missing(tracks_of(scene, seed), share / 100, seed)


def _cases(options: Options) -> Iterable[Case]:
    for share in SHARES[1:2] if options.quick else SHARES:
        for seed in options.seeds():
            for name, (method, config) in VARIANTS.items():
                keys = {"missing %": share, "method": name, "seed": seed}
                yield Case(keys, partial(_tracks, data_set_1(options), share, seed), method, config)


_PAPER = ("0.81", "1.74", "1.86", "2.39")
MISSING = Experiment(
    "missing",
    "Missing observations, synthetic 1 (published: the paper's method on its own spheres)",
    _cases,
    x="missing %",
    published={(str(share), "paper mode"): figure for share, figure in zip(SHARES, _PAPER, strict=True)},
)
