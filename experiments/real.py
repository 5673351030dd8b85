"""The real data sets with correspondences: T-shirt, Flag and KinectPaper.

Files in the project's own track format: `tshirt.npz` (10 images, 85 points), `flag.npz` (30 images, 250 points, exact
projections of motion capture) and `kinect_paper.npz` (23 images, 301 points). `experiments/README.md` says where the
originals are to be had.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial
from pathlib import Path

from connrsfm_graph.synthetic import with_missing, with_noise
from connrsfm_graph.tracks import Tracks, load_tracks
from experiments.study import VARIANTS, Case, Experiment, Options

NOISE = (5, 10, 20, 50)
"""Pixels of the T-shirt's 4800 x 3200 images."""
FLAG_NOISE = 4
"""Pixels of the Flag's 640 x 480 images, as in the paper."""


def spoilt(path: Path, noise: float, missing: float, seed: int) -> Tracks:
    """Tracks of a file with noise in pixels and percent of the observations missing."""
    tracks = load_tracks(path)
    if noise:
        tracks = with_noise(tracks, noise, seed)
    return with_missing(tracks, missing / 100, seed) if missing else tracks


def _on(options: Options, file: str, conditions: dict[str, tuple[float, float]]) -> Iterable[Case]:
    """All variants on a file under named conditions (noise in pixels, percent missing); exact ones run once."""
    path = options.data / file
    if not path.exists():
        return
    for condition, (noise, missing) in conditions.items():
        for seed in options.seeds() if noise or missing else [0]:
            for name, (method, config) in VARIANTS.items():
                keys = {"condition": condition, "method": name, "seed": seed}
                yield Case(keys, partial(spoilt, path, noise, missing, seed), method, config)


def _tshirt(options: Options) -> Iterable[Case]:
    conditions: dict[str, tuple[float, float]] = {"all points": (0, 0)}
    if not options.quick:
        conditions |= {"50 % missing": (0, 50)} | {f"{noise} px": (noise, 0) for noise in NOISE}
    return _on(options, "tshirt.npz", conditions)


def _flag(options: Options) -> Iterable[Case]:
    conditions: dict[str, tuple[float, float]] = {"exact": (0, 0), f"{FLAG_NOISE} px": (FLAG_NOISE, 0)}
    return [] if options.quick else _on(options, "flag.npz", conditions)


def _kinect_paper(options: Options) -> Iterable[Case]:
    return [] if options.quick else _on(options, "kinect_paper.npz", {"all points": (0, 0)})


TSHIRT = Experiment(
    "tshirt",
    "T-shirt: 10 images, 85 points",
    _tshirt,
    published={
        ("all points", "paper mode"): "2.24 / 17.5",
        ("all points", "infp"): "2.49 / 18.9",
        ("all points", "go20"): "2.33 / 18.4",
        ("all points", "diff"): "4.02 / 25.1",
        ("all points", "mdh"): "0.88 / 6.99",
        ("all points", "mlh"): "0.48 / 3.73",
        ("50 % missing", "paper mode"): "2.77 / 20.95",
        ("50 % missing", "mdh"): "7.02",
        ("50 % missing", "mlh"): "6.68",
    },
)
FLAG = Experiment(
    "flag",
    "Flag: 30 images, 250 points",
    _flag,
    published={
        ("4 px", "paper mode"): "1.5364",
        ("4 px", "infp"): "1.6289",
        ("4 px", "go20"): "1.5710",
        ("4 px", "diff"): "2.6631",
        ("4 px", "mdh"): "3.0996",
        ("4 px", "mlh"): "3.0309",
    },
)
KINECT_PAPER = Experiment(
    "kinect_paper",
    "KinectPaper: 23 images, 301 points",
    _kinect_paper,
    published={
        ("all points", "infp"): "1.47 / 9.5",
        ("all points", "diff"): "3.16 / 20.3",
        ("all points", "mdh"): "0.64 / 4.90",
    },
)
