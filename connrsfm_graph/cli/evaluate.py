"""Compare a result with the truth."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np

    from connrsfm_graph.metrics import Evaluation
    from connrsfm_graph.reconstruction import Reconstruction
    from connrsfm_graph.tracks import Tracks


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("result", type=Path, metavar="RESULT", help="folder of a result, or its result.npz")
    parser.add_argument("--truth", type=Path, required=True, metavar="TRACKS", help="tracks file with true points")
    parser.add_argument("--intrinsics", metavar="K", help="camera of the truth's file, where it has none")
    parser.add_argument("--json", action="store_true", help="print one JSON object instead of a table")


def run(arguments: argparse.Namespace) -> None:
    from connrsfm_graph.reconstruction import Reconstruction
    from connrsfm_graph.tracks import load_tracks

    reconstruction = Reconstruction.load(arguments.result)
    truth = load_tracks(arguments.truth, arguments.intrinsics, reconstruction.camera.name)
    evaluation, _ = evaluated(reconstruction, truth, str(arguments.truth))
    print(
        json.dumps(evaluation.to_dict(), allow_nan=False)
        if arguments.json
        else table(evaluation, reconstruction.image_names)
    )


def evaluated(reconstruction: Reconstruction, truth: Tracks, source: str) -> tuple[Evaluation, np.ndarray]:
    """Figures of a reconstruction against tracks with true points; `source` names these in messages.

    An orthographic camera cannot tell all surfaces from their mirror images in depth: the nearer of both truths counts.

    Returns:
        The figures, and the true points (F, P, 3) that they belong to.

    Raises:
        InputError: no true points, or those of other images or points.
    """
    from connrsfm_graph.errors import InputError
    from connrsfm_graph.metrics import evaluate

    if truth.points is None:
        raise InputError(f"{source}: holds no true points; expected a field 'points' of shape (frames, points, 3)")
    if truth.points.shape != reconstruction.points.shape:
        sizes = [" x ".join(map(str, array.shape[:2])) for array in (truth.points, reconstruction.points)]
        raise InputError(f"{source}: 'points' holds {sizes[0]} (frames x points), the result {sizes[1]}")
    perspective = bool(reconstruction.camera.kappa)
    found = []
    for candidate in [truth] if perspective else [truth, truth.mirrored()]:
        assert candidate.points is not None
        evaluation = evaluate(
            reconstruction.points,
            candidate.points,
            truth.visible,
            normals=reconstruction.normals,
            true_normals=candidate.normals,
            image=None if perspective else reconstruction.points[..., :2],
        )
        found.append((evaluation, candidate.points))
    return min(found, key=lambda pair: pair[0].e3d_percent)


def summary(evaluation: Evaluation) -> str:
    """The figures of the field in one line."""
    shape = evaluation.shape_error_deg
    return (
        f"3D error {evaluation.e3d_percent:.3f} %, "
        f"shape error {'unknown' if math.isnan(shape) else f'{shape:.2f} degrees'}, "
        f"3D RMSE {evaluation.rmse_3d_percent:.3f} % of the extent, coverage {100 * evaluation.coverage:.1f} %"
    )


def table(evaluation: Evaluation, names: Sequence[str] | np.ndarray | None = None) -> str:
    """One row per frame, by its name or number, and one for all."""
    names = [str(frame["frame"]) if names is None else str(names[frame["frame"]]) for frame in evaluation.per_frame]
    wide = max(6, *map(len, names))
    lines = [f"{'frame':>{wide}} {'points':>7} {'e3d %':>9} {'shape deg':>10} {'RMSE 3D':>10} {'coverage %':>11}"]
    total = {**evaluation.to_dict(), "points": sum(frame["points"] for frame in evaluation.per_frame)}
    for name, figures in [*zip(names, evaluation.per_frame, strict=True), ("all", total)]:
        coverage = None if figures["coverage"] is None else 100.0 * figures["coverage"]
        lines.append(
            f"{name:>{wide}} {figures['points']:>7} {_cell(figures['e3d_percent'], 9, 3)} "
            f"{_cell(figures['shape_error_deg'], 10, 2)} {_cell(figures['rmse_3d'], 10, 4)} {_cell(coverage, 11, 1)}"
        )
    return "\n".join(lines)


def _cell(value: float | None, width: int, digits: int) -> str:
    return f"{'-':>{width}}" if value is None else f"{value:>{width}.{digits}f}"
