"""Colours of the report: ramps for numbers and one colour per tracked point."""

from __future__ import annotations

import numpy as np

Ramp = tuple[str, ...]
DEPTH: Ramp = ("#ffe3b3", "#f5b97f", "#a5cdb9", "#62a3bb", "#4273a3")
"""Near to far."""
ERROR: Ramp = ("#eef1f3", "#fbdcae", "#f5a166", "#dc5044", "#8c1a33")
"""None to large."""
SCALE: Ramp = ("#3767a6", "#93b8d8", "#f1efe9", "#e6a27c", "#b23a2e")
"""Shrunk over unchanged to stretched."""


def ramp_colours(ramp: Ramp, values: np.ndarray, lower: float, upper: float) -> np.ndarray:
    """(..., 3) red, green, blue in 0 to 1 of values, clipped to lower and upper; NaN is grey."""
    stops = np.array([[int(code[i : i + 2], 16) for i in (1, 3, 5)] for code in ramp]) / 255.0
    along = np.clip((values - lower) / max(upper - lower, np.finfo(float).tiny), 0.0, 1.0) * (len(ramp) - 1)
    channels = [np.interp(along, np.arange(len(ramp)), stops[:, channel]) for channel in range(3)]
    colours = np.stack(channels, axis=-1)
    colours[~np.isfinite(values)] = 0.6
    return colours


def point_colours(place: np.ndarray) -> np.ndarray:
    """(P, 3) colours by place (P, 2) in one image, so that a point can be told in every other image."""
    lower, upper = np.nanmin(place, axis=0), np.nanmax(place, axis=0)
    x, y = np.clip((place - lower) / np.maximum(upper - lower, np.finfo(float).tiny), 0.0, 1.0).T
    left_top, right_top = np.array([0.93, 0.43, 0.18]), np.array([0.75, 0.20, 0.50])
    left_bottom, right_bottom = np.array([0.35, 0.62, 0.20]), np.array([0.13, 0.36, 0.70])
    x, y = x[:, None], y[:, None]
    colours = (1 - y) * ((1 - x) * left_top + x * right_top) + y * ((1 - x) * left_bottom + x * right_bottom)
    colours[~np.isfinite(colours).all(axis=1)] = 0.6
    return colours
