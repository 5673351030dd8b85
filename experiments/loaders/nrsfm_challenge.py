"""NRSfM Challenge, sequences seen by perspective cameras; the orthographic ones need another camera model."""

from __future__ import annotations

from experiments.loaders import Dataset
from experiments.loaders._stacked import load_stacked

DATASET = Dataset(
    "NRSfM Challenge, five deforming objects on six camera paths",
    "nrsfm2017.compute.dtu.dk (Jensen, Doest, Aanæs, Del Bue, IJCV 2021)",
    "one .mat file of a perspective sequence with W, NaN where not visible, GT and K",
    load_stacked,
)
