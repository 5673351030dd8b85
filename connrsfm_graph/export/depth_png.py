"""Depth maps as 16-bit PNG, the form that most tools for depth images read: a whole number per pixel, 0 for none."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.files import require_file, written_beside

_LARGEST = 65535


def png_scale(farthest: float) -> float:
    """Steps per unit of depth that use the 16 bits for depths up to `farthest`: a round number."""
    exact = _LARGEST / farthest
    power = 10.0 ** np.floor(np.log10(exact))
    return float(np.floor(exact / power) * power)


def write_depth_png(path: str | Path, depth: np.ndarray, scale: float) -> None:
    """Write depth (H, W) times `scale`, rounded; pixels with NaN become 0."""
    values = np.where(np.isfinite(depth), np.clip(np.round(depth * scale), 1, _LARGEST), 0).astype(np.uint16)
    with written_beside(path) as part:
        part.write_bytes(cv2.imencode(".png", values)[1].tobytes())


def read_depth_png(path: str | Path, scale: float) -> np.ndarray:
    """Depth (H, W), NaN where the file holds 0.

    Raises:
        InputError: no such file, or no 16-bit image with one channel.
    """
    path = Path(path)
    require_file(path)
    values = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
    if values is None or values.dtype != np.uint16 or values.ndim != 2:
        raise InputError(f"{path}: expected a 16-bit PNG with one channel")
    return np.where(values == 0, np.nan, values / scale)
