"""`.mat` files of factorisation methods: matrices with one group of rows per image, one column per point.

| field | shape | meaning |
|---|---|---|
| `W` | (2F, P) | pixels, x and y of each image; NaN where not visible |
| `GT`, `S` or `shape3D` | (3F, P) | truth in each camera's frame, optional |
| `K` | (3, 3) | intrinsics; or `K.txt` beside the file |

Orthographic sequences have no `K`: their image points are in the unit of length of the truth.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.tracks import Tracks, parse_intrinsics
from experiments.loaders._matlab import only_file
from factors.surface import ORTHOGRAPHIC, PERSPECTIVE

TRUTH = ("GT", "S", "shape3D")


def load_stacked(folder: Path, orthographic: bool = False) -> Tracks:
    """The folder's one `.mat` file in the layout above.

    Args:
        folder: where it is.
        orthographic: whether a file without a camera is taken for an orthographic sequence.

    Raises:
        InputError: `W` or the camera is missing, or shapes do not fit.
    """
    from scipy.io import loadmat

    path = only_file(folder, "*.mat")
    try:
        fields = loadmat(str(path), simplify_cells=True)
    except (ValueError, NotImplementedError, TypeError) as error:
        raise InputError(f"{path}: not a readable .mat file (damaged, or saved as v7.3)") from error
    if "W" not in fields:
        raise InputError(f"{path}: field 'W' is missing, expected a measurement matrix with two rows per image")
    camera, model = folder / "K.txt", PERSPECTIVE
    if camera.exists():
        K = parse_intrinsics(camera)
    elif "K" in fields:
        K = np.asarray(fields["K"], dtype=float)
    elif orthographic:
        K, model = np.eye(3), ORTHOGRAPHIC
    else:
        raise InputError(f"{path}: field 'K' is missing, expected it there or in {camera}")
    truth = next((fields[name] for name in TRUTH if name in fields), None)
    return Tracks.checked(
        _by_image(fields["W"], 2, f"{path}: 'W'"),
        K,
        points=None if truth is None else _by_image(truth, 3, f"{path}: truth"),
        camera=model.name,
        source=str(path),
    )


def _by_image(stacked: np.ndarray, rows: int, what: str) -> np.ndarray:
    """(F, P, rows) from (rows F, P)."""
    stacked = np.asarray(stacked)
    if stacked.ndim != 2 or len(stacked) % rows:
        raise InputError(f"{what} has shape {stacked.shape}, expected {rows} rows per image")
    return stacked.reshape(-1, rows, stacked.shape[1]).transpose(0, 2, 1)
