"""Computation time against the number of images, and against the number of threads."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial

from connrsfm_graph.synthetic import isometric_bending
from connrsfm_graph.tracks import Tracks
from experiments.study import THREADS, VARIANTS, Case, Experiment, Options

FRAMES = (10, 20, 40, 80, 160)
POINTS = 100
THREADS_FRAMES, THREADS_POINTS = 40, 300


def _tracks(n_frames: int, n_points: int) -> Tracks:
    return isometric_bending(n_frames, n_points, smooth=True).tracks


def _time(options: Options) -> Iterable[Case]:
    for n_frames in (4,) if options.quick else FRAMES:
        for name in ("default", "paper mode", "infp", "go20", "mdh"):
            method, config = VARIANTS[name]
            yield Case({"images": n_frames, "method": name}, partial(_tracks, n_frames, POINTS), method, config)


def _parallel(options: Options) -> Iterable[Case]:
    size = (4, 40) if options.quick else (THREADS_FRAMES, THREADS_POINTS)
    for threads in sorted({1, THREADS}):
        for name in ("default", "paper mode"):
            method, config = VARIANTS[name]
            keys = {"threads": threads, "method": name}
            yield Case(keys, partial(_tracks, *size), method, config, threads)


TIME = Experiment("time", "Seconds against images", _time, x="images", measure="seconds")
PARALLEL = Experiment(
    "parallel",
    "Threads",
    _parallel,
    x="threads",
    measure="seconds",
)
