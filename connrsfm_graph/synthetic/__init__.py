"""Synthetic scenes with exact truth, and ways to spoil tracks."""

from connrsfm_graph.synthetic.corruption import with_missing, with_noise, with_outliers
from connrsfm_graph.synthetic.scene import Scene
from connrsfm_graph.synthetic.scenes import isometric_bending, mixed, moebius, spheres
from connrsfm_graph.synthetic.variety import varied

__all__ = [
    "Scene",
    "isometric_bending",
    "mixed",
    "moebius",
    "spheres",
    "varied",
    "with_missing",
    "with_noise",
    "with_outliers",
]
