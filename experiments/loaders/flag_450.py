"""Flag, 450 images from motion capture."""

from __future__ import annotations

from experiments.loaders import Dataset
from experiments.loaders._matlab import load_matlab

DATASET = Dataset(
    "Flag, 450 images from motion capture",
    "github.com/cyb1212/non-rigid-structure-from-motion-based-on-SOCP-Winter-school (data/flag)",
    "one .mat file with scene.m, scene.Pgth and scene.K, or p and Pgth",
    load_matlab,
)
