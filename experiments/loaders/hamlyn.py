"""Hamlyn, endoscopic stereo video of living tissue."""

from __future__ import annotations

from experiments.loaders import Dataset
from experiments.loaders._images import load_images

DATASET = Dataset(
    "Hamlyn, endoscopic stereo video of living tissue",
    "hamlyn.doc.ic.ac.uk/vision; depth maps of Endo-Depth-and-Motion (Recasens et al., RA-L 2021)",
    "images/, K.txt and depth/, masks/ against specular borders if wanted",
    load_images,
)
