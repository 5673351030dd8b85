"""The view of the report that turns: surfaces and photos as data, and the script that draws them.

Numbers travel as base64 of little-endian arrays, coordinates as 16-bit steps, so that a page of 50 textured surfaces is
a few MB. The script needs no library, network or graphics card.
"""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Sequence
from importlib import resources
from typing import Any

import numpy as np

from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.report.photos import Photo
from connrsfm_graph.report.shown import DenseSurfaces, Paint, paints, shown_mesh
from connrsfm_graph.report.surfaces import Surfaces

MAX_VERTICES = 80_000
"""Vertices of all images of a page; dense surfaces get fewer each where there are many."""
FINEST = 4000
"""Vertices of one dense surface at most."""
MAX_FRAMES = 200
"""Images in the view; of longer sequences every second, third, ... is left out."""
STEPS = 8000
"""16-bit steps per unit; coordinates of up to four units fit."""
UNKNOWN = 255
"""The number that stands for no value; values are 0 to 254."""
MISSING = -32768
"""The step that stands for no coordinate."""


def viewer(
    reconstruction: Reconstruction,
    surfaces: Surfaces,
    photos: Sequence[Photo] | None = None,
    dense: DenseSurfaces | None = None,
) -> str:
    """A canvas, the photo beside it, a slider over images, and whatever they show; empty where there is no surface."""
    if not surfaces.frames:
        return ""
    every = -(-len(surfaces.frames) // MAX_FRAMES)
    frames = surfaces.frames[::every]
    ways = paints(surfaces)
    most = min(FINEST, MAX_VERTICES // len(frames))
    content = {
        "steps": STEPS,
        "unknown": UNKNOWN,
        "missing": MISSING,
        "paints": [{"ramp": way.ramp, "ends": way.ends, "unit": way.unit} for way in ways],
        "frames": [_frame(reconstruction, surfaces, photos, dense, ways, f, most) for f in frames],
    }
    # "</" would end the script element early.
    data = json.dumps(content, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
    script = resources.files(__package__).joinpath("viewer.js").read_text(encoding="utf-8")
    options = ["<option value=-1>image</option>"] if photos is not None else []
    options += [f"<option value={number}>{html.escape(way.name)}</option>" for number, way in enumerate(ways)]
    compared = "<label><input type=checkbox id=truth> truth as lines</label>" if surfaces.truth is not None else ""
    kind = "Dense surfaces" if dense is not None else "Triangles between the tracked points"
    beside = '<img id=photo alt="Input image">' if photos is not None else ""
    return (
        f"<h2>Surface</h2><p>{kind}. Drag to turn, double-click to return, Ctrl and wheel to come nearer. The slider "
        f"goes through the images{f', every {every} of them' if every > 1 else ''}.</p>"
        f'<div class=viewer><div class=stage><canvas id=view aria-label="Recovered surface"></canvas>{beside}</div>'
        "<div class=controls><button id=play type=button>play</button>"
        f"<label class=slide>image <input type=range id=frame min=0 max={len(frames) - 1} value=0></label>"
        f"<output id=name></output><label>colour <select id=paint>{''.join(options)}</select></label>{compared}"
        "<output id=legend></output></div></div>\n"
        f'<script type="application/json" id=surfaces>{data}</script>\n<script>\n{script}</script>'
    )


def _frame(
    reconstruction: Reconstruction,
    surfaces: Surfaces,
    photos: Sequence[Photo] | None,
    dense: DenseSurfaces | None,
    ways: Sequence[Paint],
    f: int,
    most: int,
) -> dict[str, Any]:
    """One image's surface about its centre in units of the largest one's radius, and its colours."""
    mesh = shown_mesh(reconstruction, surfaces, dense, f, most)
    unit, centre = surfaces.radius, surfaces.centre[f]
    frame: dict[str, Any] = {
        "name": reconstruction.frame_name(f),
        "points": _packed(_steps((mesh.points - centre) / unit), "<i2"),
        "triangles": _packed(mesh.triangles, _index_kind(mesh.points)),
        "values": [_packed(_levels(mesh.values[way.name], way), "u1") for way in ways],
    }
    if photos is not None:
        frame["photo"] = photos[f].jpeg()
        # Pixels of the photo in eighths; its centres are at whole numbers.
        frame["texture"] = _packed(np.clip(np.round(8 * photos[f].place(mesh.pixels)), -32767, 32767), "<i2")
    if surfaces.truth is not None:
        frame["truth"] = _packed(_steps((surfaces.truth[f] - centre) / unit), "<i2")
        frame["lines"] = _packed(surfaces.triangles[f], _index_kind(surfaces.truth[f]))
    return frame


def _steps(values: np.ndarray) -> np.ndarray:
    """Coordinates as 16-bit steps, MISSING where a row is not finite."""
    steps = np.clip(np.round(STEPS * np.nan_to_num(values)), -32767, 32767)
    steps[~np.isfinite(values).all(axis=1)] = MISSING
    return steps


def _levels(values: np.ndarray, way: Paint) -> np.ndarray:
    """Numbers as 0 to 254 from the lower to the upper end, UNKNOWN where not finite."""
    along = np.clip((values - way.lower) / (way.upper - way.lower), 0.0, 1.0)
    return np.where(np.isfinite(values), np.round(np.nan_to_num(along) * (UNKNOWN - 1)), UNKNOWN)


def _index_kind(points: np.ndarray) -> str:
    """The smallest numbers that name all points; the script chooses likewise."""
    return "<u2" if len(points) < 2**16 else "<u4"


def _packed(array: np.ndarray, kind: str) -> str:
    return base64.b64encode(np.ascontiguousarray(array).astype(kind).tobytes()).decode()
