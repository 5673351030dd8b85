"""Rug, 159 images of 3900 points from a Kinect."""

from __future__ import annotations

from experiments.loaders import Dataset
from experiments.loaders._matlab import load_matlab

DATASET = Dataset(
    "Rug, 159 images of 3900 points from a Kinect",
    "the authors' data page of Parashar, Pizarro, Bartoli, TPAMI 2018 (igt.ip.uca.fr/encov)",
    "one .mat file with qgth and Pgth; K.txt if its points are pixels",
    load_matlab,
)
