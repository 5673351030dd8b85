"""`.mat` files in the layouts of public NRSfM code, with the camera in a file of its own or nowhere."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.tracks import Tracks, parse_intrinsics
from connrsfm_graph.tracks.matlab import read_mat

VIRTUAL = np.diag([1000.0, 1000.0, 1.0])
"""Camera of files that hold normalised coordinates only: pixels are then thousandths of the focal length."""


def only_file(folder: Path, pattern: str) -> Path:
    """The one file in a folder that matches a pattern.

    Raises:
        InputError: no file matches, or several do.
    """
    found = sorted(folder.glob(pattern))
    if len(found) != 1:
        raise InputError(f"{folder}: holds {len(found)} files '{pattern}', expected one")
    return found[0]


def load_matlab(folder: Path) -> Tracks:
    """The folder's one `.mat` file; its camera is `K.txt` beside it, or virtual where that is absent."""
    camera = folder / "K.txt"
    return read_mat(only_file(folder, "*.mat"), parse_intrinsics(camera) if camera.exists() else VIRTUAL)
