"""KinectPaper at full size; the experiments use every 8th image and every 5th point of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.tracks import Tracks
from connrsfm_graph.tracks.matlab import read_mat
from experiments.loaders import Dataset


def load(folder: Path) -> Tracks:
    """`KinectPaper.mat` (p, Pgth) with the camera KK of `camcalib.mat`."""
    from scipy.io import loadmat

    files = [folder / name for name in ("KinectPaper.mat", "camcalib.mat")]
    for path in files:
        if not path.exists():
            raise InputError(f"{path}: no such file, expected it with the data set")
    camera = loadmat(str(files[1]), simplify_cells=True)
    if "KK" not in camera:
        raise InputError(f"{files[1]}: field 'KK' is missing, expected (3, 3) intrinsics")
    return read_mat(files[0], np.asarray(camera["KK"], dtype=float))


DATASET = Dataset(
    "KinectPaper, 191 images of 1503 points",
    "github.com/ajadchhatkuli/mdh-nrsfm (from Varol, Salzmann, Fua, Urtasun, CVPR 2012)",
    "KinectPaper.mat and camcalib.mat",
    load,
)
