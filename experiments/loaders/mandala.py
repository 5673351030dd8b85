"""Mandala, a cloth under increasing deformation, stereo video."""

from __future__ import annotations

from experiments.loaders import Dataset
from experiments.loaders._images import load_images

DATASET = Dataset(
    "Mandala, a cloth under increasing deformation, stereo video",
    "DefSLAM data (Lamarca, Parashar, Bartoli, Montiel, T-RO 2021; github.com/UZ-SLAMLab/DefSLAM)",
    "images/, K.txt, and depth/ from the stereo pairs",
    load_images,
)
