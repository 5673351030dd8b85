"""One whole reconstruction in a process of its own, for peak memory and times that nothing else has a part in.

    python -m experiments.benchmarks.run_once TRACKS TRUTH [--workers N] [--memory-limit SIZE]

prints one JSON object. The process is warm: compiled code was loaded by a small run before. TRACKS is a tracks file
without truth, TRUTH an `.npz` with true `points` of some `frames`.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from connrsfm_graph import others
from connrsfm_graph.keyframes import KeyframeConfig
from connrsfm_graph.metrics import evaluate
from connrsfm_graph.progress import Progress
from connrsfm_graph.reconstruct import Config, reconstruct
from connrsfm_graph.running.config import RunningConfig
from connrsfm_graph.synthetic import isometric_bending
from connrsfm_graph.tracks import check_reconstructable, load_tracks

WARPS = "warps of other images"
"""Seconds of warps within the stage of the other images, where this process works on them."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tracks", type=Path)
    parser.add_argument("truth", type=Path)
    parser.add_argument("--workers", type=int)
    parser.add_argument("--memory-limit")
    given = parser.parse_args(arguments)
    warm_up()
    tracks = load_tracks(given.tracks)
    config = Config(running=RunningConfig(workers=given.workers, memory_limit=given.memory_limit))
    progress = Progress()
    with_warps_timed(progress)
    started = time.perf_counter()
    checked, _ = check_reconstructable(tracks)
    result, record = reconstruct(checked, config, progress)
    seconds = time.perf_counter() - started
    with np.load(given.truth) as truth:
        frames, points = truth["frames"], truth["points"]
    outcome = {
        "seconds": seconds,
        "stages": progress.seconds,
        "pairs": int(np.isfinite(result.conformal_scale).sum()),
        "keyframes": record.decisions["keyframes"]["jointly"],
        "peak MiB": record.peak_memory_mib,
        "3D error %": evaluate(result.points[frames], points).e3d_percent,
    }
    print(json.dumps(outcome))


def warm_up() -> None:
    """Load all compiled code."""
    reconstruct(isometric_bending(9, 40, smooth=True).tracks, Config(keyframes=KeyframeConfig(most=5)))


def with_warps_timed(progress: Progress) -> None:
    """Note the time of the warps of images that follow keyframes as a stage of its own."""
    fit_warps = others.fit_warps

    def timed(*given: Any) -> Any:
        started = time.perf_counter()
        warps = fit_warps(*given)
        progress.seconds[WARPS] = progress.seconds.get(WARPS, 0.0) + time.perf_counter() - started
        return warps

    others.fit_warps = timed  # type: ignore[assignment]


if __name__ == "__main__":
    main()
