"""The view of the report that turns: surfaces as data and the script that draws them."""

from __future__ import annotations

import json
from importlib import resources
from typing import Any

import numpy as np

from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.report.colour import DEPTH, ERROR
from connrsfm_graph.report.surfaces import Surfaces

MAX_NUMBERS = 600_000
"""A page with more surface points than a third of this would load slowly; then every second, third, ... image is left
out."""


def viewer(reconstruction: Reconstruction, surfaces: Surfaces) -> str:
    """A canvas with a slider over images, and whatever it draws as JSON; empty where there is no surface."""
    if not surfaces.frames:
        return ""
    every = -(-surfaces.points[surfaces.frames].size // MAX_NUMBERS)
    frames = surfaces.frames[::every]
    unit = surfaces.radius()
    content = {
        "ramps": [DEPTH, ERROR],
        "frames": [_frame(reconstruction, surfaces, f, unit) for f in frames],
    }
    # "</" would end the script element early.
    data = json.dumps(content, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
    script = resources.files(__package__).joinpath("viewer.js").read_text(encoding="utf-8")
    compared = surfaces.truth is not None
    paint = (
        "<label>colour <select id=paint><option value=0>depth</option><option value=1>error</option></select></label>"
        "<label><input type=checkbox id=truth> truth as lines</label>"
    )
    return (
        "<h2>Surface</h2><p>Drag to turn, double-click to return. The slider goes through the images"
        f"{f', every {every} of them' if every > 1 else ''}.</p>"
        '<div class=viewer><canvas id=view aria-label="Recovered surface"></canvas><div class=controls>'
        f"<label class=slide>image <input type=range id=frame min=0 max={len(frames) - 1} value=0></label>"
        f"<output id=name></output>{paint if compared else ''}</div></div>\n"
        f'<script type="application/json" id=surfaces>{data}</script>\n<script>\n{script}</script>'
    )


def _frame(reconstruction: Reconstruction, surfaces: Surfaces, f: int, unit: float) -> dict[str, Any]:
    """One image's surface in units of `unit` from its centre, and its colours from 0 to 1."""
    lower, upper = surfaces.relief_range()
    values = [_rounded((surfaces.relief[f] - lower) / (upper - lower))]
    if surfaces.error is not None:
        values.append(_rounded(surfaces.error[f] / surfaces.error_range()[1]))
    frame = {
        "name": reconstruction.frame_name(f),
        "triangles": surfaces.triangles[f].tolist(),
        "points": _rounded((surfaces.points[f] - surfaces.centre[f]) / unit),
        "values": values,
    }
    if surfaces.truth is not None:
        frame["truth"] = _rounded((surfaces.truth[f] - surfaces.centre[f]) / unit)
    return frame


def _rounded(values: np.ndarray) -> list[Any]:
    """Rows with three digits after the point; null where a row is not finite."""
    known = np.isfinite(values) if values.ndim == 1 else np.isfinite(values).all(axis=1)
    return [row if ok else None for row, ok in zip(np.round(values, 3).tolist(), known, strict=True)]
