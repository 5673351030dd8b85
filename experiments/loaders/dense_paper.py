"""dense Kinect paper, 193 images."""

from __future__ import annotations

from experiments.loaders import Dataset
from experiments.loaders._stacked import load_stacked

DATASET = Dataset(
    "dense Kinect paper, 193 images",
    "Varol, Salzmann, Fua, Urtasun, CVPR 2012 (EPFL CVLab); tracks from Kumar, Cherian, Dai, Li, CVPR 2018",
    "one .mat file with W and GT",
    load_stacked,
)
