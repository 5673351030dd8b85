"""NRSfM Challenge: sequences seen by perspective cameras, and the same by orthographic ones."""

from __future__ import annotations

from functools import partial

from experiments.loaders import Dataset
from experiments.loaders._stacked import load_stacked

DATASET = Dataset(
    "NRSfM Challenge, five deforming objects on six camera paths",
    "nrsfm2017.compute.dtu.dk (Jensen, Doest, Aanæs, Del Bue, IJCV 2021)",
    "one .mat file of a sequence with W, NaN where not visible, and GT; with K perspective, without orthographic",
    partial(load_stacked, orthographic=True),
)
