"""From sparse normals to dense depth: network against spline, and the paper's ablation of encoder and augmentation.

Three tables, all mean relative errors of depth:

- `simulated`: held-out surfaces of the training's kind with noise on their sparse normals, in sequences of 16, and
  nothing but normals. The spline integrates their slopes, with the bending weight by cross-validation over a sequence,
  as the reconstruction does; the network reads their image. Both answer on the same grid; each surface is scaled so
  that the mean log depths agree. `constant` answers with one depth.
- `real`: every second true point of the real data sets, with normals by a spline through them, is densified as by
  `connrsfm densify`, that is with their depths; the error is that at the other points.
- `ablation`: encoders trained for the same few steps on the same surfaces, the compact one with and without noise.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from connrsfm_graph.dense.choose import DepthMethod
from connrsfm_graph.dense.simulated import Batch, simulate
from connrsfm_graph.dense.sparse import SparsePoints
from connrsfm_graph.dense.spline_depth import SplineDepth, on_grid
from connrsfm_graph.dense.window import grid, slopes
from connrsfm_graph.metrics.surface_normals import TRUTH, surface_normals
from connrsfm_graph.surface_spline import SurfaceSpline, choose_bending
from connrsfm_graph.tracks import load_tracks
from connrsfm_graph.warps.basis import U, V
from experiments.study import Options, append_row, read_rows
from factors.surface import PERSPECTIVE

if TYPE_CHECKING:
    from connrsfm_graph.dense.checkpoint import Checkpoint
    from connrsfm_graph.dense.train import TrainConfig

NOISE = (0.0, 0.1, 0.2)
"""Standard deviations of the noise on the components of unit normals."""
SIZE = 64
SEQUENCE = 16
"""Simulated surfaces that are answered together, as are the images of a sequence."""
FRAME = (640, 480)
"""Pixels of the depth maps of real data, whose cameras are scaled to this width."""
DATA = ("tshirt", "flag", "kinect_paper")
TRAINED = (("compact", 0.25), ("compact", 0.0), ("resnet50", 0.25), ("densenet169", 0.25))
"""Encoders of the ablation and the largest noise on the normals in their training."""
ABLATION_STEPS, ABLATION_BATCH = 80, 8
_HELD_OUT = 2
"""First number of the keys of these surfaces; training and its own evaluation use others."""
_CONTROL_POINTS, _HUBER = 14, 2.0

Row = dict[str, str]


def measure(options: Options) -> None:
    """Write dense.csv, dense.md and, of the shipped network's training, dense.png; nothing where torch is missing."""
    try:
        import torch
    except ModuleNotFoundError:
        print("dense: skipped, torch is not installed (pip install '.[dense]')")
        return
    from connrsfm_graph.dense.checkpoint import SHIPPED, Checkpoint

    torch.set_num_threads(1)
    checkpoint = Checkpoint.load(SHIPPED)
    path = options.out / "dense.csv"
    done = {(row["table"], row["method"], row["condition"]) for row in read_rows(path)}
    for part in (_simulated, _real, _ablation):
        for keys, run in part(options, checkpoint):
            if keys not in done:
                errors, milliseconds = run()
                figures = {
                    "error_percent": f"{100 * statistics.fmean(errors):.3g}",
                    "median_percent": f"{100 * statistics.median(errors):.3g}",
                    "milliseconds": f"{milliseconds:.1f}",
                }
                append_row(path, dict(zip(("table", "method", "condition"), keys, strict=True)) | figures)
    text = _markdown(read_rows(path))
    (options.out / "dense.md").write_text(text, encoding="utf-8")
    print(text)
    draw_training(checkpoint, options.out / "dense.png")


Figures = tuple[list[float], float]
"""Errors (of sequences, images or one for all) and milliseconds per image."""
Runs = Iterator[tuple[tuple[str, str, str], Callable[[], Figures]]]
"""Keys of rows, and what measures their figures."""


def _simulated(options: Options, checkpoint: Checkpoint) -> Runs:
    methods: dict[str, Callable[[Batch], np.ndarray]] = {
        "constant": lambda batch: np.zeros_like(batch.log_depth),
        "spline": integrated,
        "network": lambda batch: predicted(batch, checkpoint),
    }
    sequences = 1 if options.quick else 25
    for (name, method), noise in product(methods.items(), NOISE):
        yield ("simulated", name, f"noise {noise:.0%}"), partial(_held_out, method, sequences, noise)


def _held_out(method: Callable[[Batch], np.ndarray], sequences: int, noise: float) -> Figures:
    """Error of a method and milliseconds per surface, answered `SEQUENCE` at a time."""
    from connrsfm_graph.dense.train import relative_error

    errors, seconds = [], []
    for number in range(-1, sequences):  # the first one warms up
        batch = simulate(SEQUENCE, SIZE, (_HELD_OUT, abs(number)), (noise, noise))
        start = time.perf_counter()
        log_depth = method(batch)
        seconds.append(time.perf_counter() - start)
        errors.append(relative_error(log_depth, batch.log_depth, batch.mask))
    return errors[1:], 1e3 * statistics.median(seconds[1:]) / SEQUENCE


def integrated(batch: Batch) -> np.ndarray:
    """Log depths (B, S, S) from sparse slopes, as `connrsfm_graph.integrate` does it for the images of a sequence."""
    splines = []
    for p, m, seen in zip(batch.p, batch.m, batch.observed, strict=True):
        ones = np.ones(seen.sum())
        splines.append(SurfaceSpline(p[seen], (U, V), slopes(m[seen]), ones, p[seen], _CONTROL_POINTS, PERSPECTIVE))
    bending = choose_bending(splines)
    for _ in range(3):
        spread = 1.4826 * float(np.median(np.concatenate([spline.residual_norms(bending) for spline in splines])))
        for spline in splines:
            spline.reweight(_HUBER * spread, bending)
    return np.stack([on_grid(spline.grid, spline.control(bending), grid(SIZE), grid(SIZE)) for spline in splines])


def predicted(batch: Batch, checkpoint: Checkpoint) -> np.ndarray:
    """Log depths (B, S, S) by the network, the images of normals included."""
    from connrsfm_graph.dense.field import normal_images
    from connrsfm_graph.dense.network import predict

    images = normal_images(batch.p, batch.m, batch.observed.astype(float), SIZE)
    return predict(checkpoint.network, images, batch.mask)


def _real(options: Options, checkpoint: Checkpoint) -> Runs:
    from connrsfm_graph.dense.network_depth import NetworkDepth

    methods: dict[str, Callable[[list[SparsePoints]], DepthMethod]] = {
        "spline": SplineDepth,
        "network": lambda images: NetworkDepth(checkpoint, images),
    }
    for data, (name, method) in product(DATA, methods.items()):
        path = options.data / f"{data}.npz"
        if path.exists() and not options.quick:
            yield ("real", name, data), partial(_left_out, method, path)


def _left_out(method: Callable[[list[SparsePoints]], DepthMethod], file: Path) -> Figures:
    """Error at every second true point, and milliseconds per image, of a method that is given the others."""
    tracks = load_tracks(file)
    assert tracks.points is not None, "the real data sets hold true points"
    given, left = [], []
    for points, camera in zip(tracks.points, tracks.K, strict=True):
        K = np.diag([FRAME[0] / (2.0 * camera[0, 2])] * 2 + [1.0]) @ camera
        known = points[np.isfinite(points).all(axis=1)]
        pixels = known @ K.T
        image = known[:, :2] / known[:, 2:]
        normals = surface_normals(image[::2], known[::2], TRUTH)
        given.append(SparsePoints(pixels[::2, :2] / pixels[::2, 2:], known[::2, 2], normals, K))
        left.append((pixels[1::2, :2] / pixels[1::2, 2:], known[1::2, 2]))
    method(given[:1])
    start = time.perf_counter()
    made = method(given)
    for number in range(len(given)):
        made.depth(number, FRAME)
    seconds = (time.perf_counter() - start) / len(given)
    errors = [np.abs(made.depth_at(n, pixels) / depth - 1.0).mean() for n, (pixels, depth) in enumerate(left)]
    return [float(error) for error in errors], 1e3 * seconds


def _ablation(options: Options, checkpoint: Checkpoint) -> Runs:
    from connrsfm_graph.dense.train import TrainConfig

    trained, steps, held_out = (TRAINED[:2], 2, 8) if options.quick else (TRAINED, ABLATION_STEPS, 128)
    for encoder, noise in trained:
        config = TrainConfig(
            variant=encoder, steps=steps, batch=ABLATION_BATCH, noise=noise, every=steps, held_out=held_out
        )
        name = f"{encoder}, {'noise' if noise else 'no noise'} in training"
        file = options.out / f"dense_{encoder}_{noise:g}.pt"
        for tested in (NOISE[0], NOISE[-1]):
            yield ("ablation", name, f"noise {tested:.0%}"), partial(_trained, config, file, tested)


def _trained(config: TrainConfig, file: Path, noise: float) -> Figures:
    """Error on held-out surfaces, and milliseconds per surface in batches, of a network trained now or before."""
    from connrsfm_graph.dense.checkpoint import Checkpoint
    from connrsfm_graph.dense.train import held_out_error, train

    network = (Checkpoint.load(file) if file.exists() else train(config, file)).network
    start = time.perf_counter()
    error = held_out_error(network, config, noise)
    return [error], 1e3 * (time.perf_counter() - start) / config.held_out


def _markdown(rows: list[Row]) -> str:
    """A table per kind of measurement, a line per method and a column per condition."""
    lines = ["### Dense depth: mean relative error in percent / its median (milliseconds per image)", ""]
    for table in ("simulated", "real", "ablation"):
        own = [row for row in rows if row["table"] == table]
        conditions = list(dict.fromkeys(row["condition"] for row in own))
        if own:
            lines += [f"| {table} | {' | '.join(conditions)} |", f"|---|{'---|' * len(conditions)}"]
        for method in dict.fromkeys(row["method"] for row in own):
            found = {row["condition"]: row for row in own if row["method"] == method}
            cells = [_cell(found[condition]) if condition in found else "" for condition in conditions]
            lines.append(f"| {method} | {' | '.join(cells)} |")
        lines += [""] * bool(own)
    return "\n".join(lines)


def _cell(row: Row) -> str:
    mean, median = row["error_percent"], row["median_percent"]
    return f"{mean if mean == median else f'{mean} / {median}'} ({row['milliseconds']})"


def draw_training(checkpoint: Checkpoint, path: Path) -> None:
    """Error on held-out surfaces against steps of a network's training, as PNG."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    history = checkpoint.card["history"]
    steps = [row["step"] for row in history]
    figure, axes = plt.subplots(figsize=(6.0, 3.5))
    for name, label in (("clean", "clean normals"), ("noisy", "20 % noise on the normals")):
        axes.semilogy(steps, [100 * row[name] for row in history], marker="o", markersize=3, label=label)
    axes.set(xlabel="step", ylabel="relative error of depth, percent", title=f"Training of {checkpoint.variant}")
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    plt.close(figure)
