"""Which pairs of images are used (stub contract, implementation follows)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ImageGraph:
    """Selected edges of the image graph."""

    n_frames: int
    edges: np.ndarray
    """(E, 2) int, images a and b of each edge; the warp of an edge maps image a to image b. Tree edges first."""
    weight: np.ndarray
    """(E,) weight of each edge."""
    n_tree: int
    """The first n_tree edges are the maximum spanning tree."""
