"""The whole pipeline, tracks to points: seconds per image and stage, time per pair and peak memory against size.

Sequences are a smoothly bending sheet with exact truth; from `REPEATED` images on they are repeated, as the paper
does. Every size is measured in a process of its own. A run that misses the truth is a failure.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable
from functools import partial
from pathlib import Path

import numpy as np

from connrsfm_graph.synthetic import isometric_bending
from experiments.benchmarks.run_once import WARPS
from experiments.benchmarks.table import Columns, Row, Table, cores

SIZES = ((10, 85), (30, 250), (159, 300), (191, 1503), (791, 300), (1581, 300), (7901, 300))
"""Images and points. A size beyond them: `--sizes 47700x300`."""
REFERENCE = (159, 300)
"""Time per pair is compared with that of this size."""
PARALLEL = (400, 300)
REPEATED = 1581
EVALUATED = 20
"""Images compared with the truth, spread evenly."""
MOST_ERROR = 0.1
"""3D error, percent."""
MEMORY = "2GiB"
STAGES = {
    "warps": ("image graph", "warps"),
    "solve": ("pre-step", "solve"),
    "refinement": ("noise level", "refinement"),
    "surfaces": ("surfaces",),
    "other images": ("other images",),
}
"""Columns, and the stages in them."""


def write_sequence(folder: Path, n_frames: int, n_points: int) -> None:
    """`tracks.npz`, and `truth.npz` of some images."""
    base = isometric_bending(min(n_frames, REPEATED), n_points, smooth=True).tracks
    which = np.arange(n_frames) % base.n_frames
    frames = np.unique(np.linspace(0, n_frames - 1, EVALUATED).round().astype(int))
    assert base.points is not None
    np.savez(folder / "tracks.npz", tracks=base.pixels[which], K=base.K[0], visible=base.visible[which])
    np.savez(folder / "truth.npz", frames=frames, points=base.points[which[frames]])


def measured(n_frames: int, n_points: int, threads: int, workers: int | None = None, memory: str = MEMORY) -> Row:
    """A run of this size.

    Raises:
        RuntimeError: it failed, or missed the truth.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_sequence(folder, n_frames, n_points)
        command = [sys.executable, "-m", "experiments.benchmarks.run_once", str(folder / "tracks.npz")]
        command += [str(folder / "truth.npz"), "--memory-limit", memory]
        command += [] if workers is None else ["--workers", str(workers)]
        environment = os.environ | {"NUMBA_NUM_THREADS": str(threads)}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise RuntimeError(done.stderr.strip().splitlines()[-1] if done.stderr.strip() else "no result")
    found = json.loads(done.stdout.splitlines()[-1])
    if not found["3D error %"] < MOST_ERROR:
        raise RuntimeError(f"3D error {found['3D error %']:.3f} %, expected below {MOST_ERROR} %")
    stages = found["stages"]
    row: Row = {name: round(sum(stages.get(stage, 0.0) for stage in of), 3) for name, of in STAGES.items()}
    if WARPS in stages or not stages.get("other images"):
        row["of these warps"] = round(stages.get(WARPS, 0.0), 3)
    row |= {"seconds": round(found["seconds"], 3), "pairs": found["pairs"], "keyframes": found["keyframes"]}
    row |= {"microseconds per pair": round(1e6 * found["seconds"] / found["pairs"], 2)}
    return row | {"peak MiB": round(found["peak MiB"]), "3D error %": round(found["3D error %"], 5)}


def measure_pipeline(out: Path, sizes: Iterable[tuple[int, int]] = SIZES) -> None:
    """`pipeline.csv` and `.md`."""
    table = Table(out, "pipeline", ("images", "points"))

    def against(row: Row) -> str:
        """Time per pair against that of the reference."""
        found = [r for r in table.rows if (r["images"], r["points"]) == REFERENCE and not r["failure"]]
        per_pair = "microseconds per pair"
        return f"{float(row[per_pair]) / float(found[0][per_pair]):.2f}" if found else ""

    def without_warps(row: Row) -> str:
        """Known where one process worked on all images."""
        if row.get("of these warps", "") == "":
            return ""
        rest = float(row["seconds"]) - float(row["warps"]) - float(row["of these warps"])
        return f"{rest / float(row['images']):.3f}"

    def milliseconds(column: str, row: Row) -> str:
        return f"{1e3 * float(row[column]) / float(row['images']):.1f}"

    columns: Columns = {
        "images": lambda row: str(row["images"]),
        "points": lambda row: str(row["points"]),
        "jointly": lambda row: str(row["keyframes"]),
        "s": lambda row: f"{float(row['seconds']):.1f}",
        "s per image": lambda row: f"{float(row['seconds']) / float(row['images']):.3f}",
        **{f"{name}, ms per image": partial(milliseconds, name) for name in STAGES},
        "without warps, s per image": without_warps,
        "µs per pair": lambda row: str(row["microseconds per pair"]),
        "against 159 x 300": against,
        "peak MiB": lambda row: str(row["peak MiB"]),
        "3D error %": lambda row: str(row["3D error %"]),
    }
    for n_frames, n_points in sizes:
        memory = MEMORY if n_frames * n_points < 1e7 else "8GiB"
        keys: Row = {"images": n_frames, "points": n_points}
        table.measure(keys, partial(measured, n_frames, n_points, cores(), memory=memory))
        table.write(columns)


def measure_parallel(out: Path, size: tuple[int, int] = PARALLEL) -> None:
    """`parallel.csv` and `.md`: one thread, all threads of one process, all processes of one thread."""
    table = Table(out, "parallel", ("processes", "threads"))

    def times(row: Row) -> str:
        first = table.rows[0]
        return f"{float(first['seconds']) / float(row['seconds']):.2f}" if not first["failure"] else ""

    columns: Columns = {
        "processes": lambda row: str(row["processes"]),
        "threads of each": lambda row: str(row["threads"]),
        "s": lambda row: f"{float(row['seconds']):.1f}",
        "other images, s": lambda row: f"{float(row['other images']):.1f}",
        "times as fast": times,
        "peak MiB": lambda row: str(row["peak MiB"]),
    }
    for workers, threads in ((1, 1), (1, cores()), (cores(), 1)):
        keys: Row = {"processes": workers, "threads": threads}
        # The first process has its threads in the stages before the others start.
        table.measure(keys, partial(measured, *size, max(threads, workers), workers))
        table.write(columns)
