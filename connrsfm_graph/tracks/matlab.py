"""Tracks from the `.mat` files that public NRSfM code ships with its data.

There is no agreed format, but three habits cover nearly all of it (k counts images, columns are points):

| image points | truth | camera | visibility |
|---|---|---|---|
| `scene.m(k).m` or `.p`, 2 or 3 rows | `scene.Pgth(k).P`, 3 rows | `scene.K` | `scene.v` |
| `p(k).p` or `m(k).m`, struct or cell array | `Pgth(k).P` | `K` or `KK` | `v` |
| `qgth`, cell array or 2 rows per image | `Pgth`, cell array or 3 rows per image | `K` or `KK` | `v` |

Whether image points are pixels or normalised coordinates is not written anywhere either: values within +-10 are taken
as normalised (no camera sees 84 degrees off its axis) and converted to pixels by the intrinsics.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.tracks.tracks import Tracks
from factors.surface import PERSPECTIVE

_IMAGE_FIELDS = ("m", "p", "qgth")
_NORMALISED_LIMIT = 10.0


def read_mat(path: Path, K: np.ndarray | None, camera: str = PERSPECTIVE.name) -> Tracks:
    """Read one of the layouts above; `K` overrides the file's camera.

    Truth with non-positive depth means "unknown" in these files of perspective cameras and becomes NaN.

    Raises:
        InputError: another kind of file, none of the known fields, no camera, or shapes that do not fit.
    """
    content = _load(path)
    scene = content.get("scene")
    fields: Mapping[str, Any] = scene if isinstance(scene, Mapping) else content
    name = next((name for name in _IMAGE_FIELDS if name in fields), None)
    if name is None:
        found = ", ".join(f"'{key}'" for key in fields if not key.startswith("__")) or "nothing"
        raise InputError(f"{path}: no known field, expected 'scene' with 'm', or 'p', 'm' or 'qgth'; found {found}")
    image = _by_frame(fields[name], 2, f"{path}: '{name}'")[..., :2]
    if K is None:
        K = _camera(fields, f"{path}")
    finite = np.isfinite(image).all(axis=-1)
    visible = _visible(fields["v"], image.shape[:2], f"{path}: 'v'") & finite if "v" in fields else finite
    if visible.any() and np.abs(image[visible]).max() <= _NORMALISED_LIMIT:
        cameras = np.broadcast_to(K, (len(image), 3, 3))
        image = np.einsum("fij,fpj->fpi", cameras[:, :2, :2], image) + cameras[:, None, :2, 2]
    truth = None
    if "Pgth" in fields:
        truth = _by_frame(fields["Pgth"], 3, f"{path}: 'Pgth'")[..., :3]
        if camera == PERSPECTIVE.name:
            truth = np.where(truth[..., 2:] > 0, truth, np.nan)
    return Tracks.checked(image, K, visible, truth, camera=camera, source=str(path))


def _load(path: Path) -> dict[str, Any]:
    from scipy.io import loadmat

    try:
        return loadmat(str(path), simplify_cells=True)
    except NotImplementedError as error:
        raise InputError(
            f"{path}: is a MATLAB v7.3 file, which is not read; open it in MATLAB or Octave and save it with "
            "save('tracks.mat', '-v7')"
        ) from error
    except MemoryError as error:
        raise InputError(f"{path}: declares arrays larger than the memory (damaged, or not a tracks file)") from error
    except Exception as error:  # scipy reports damage by many kinds of exceptions
        raise InputError(f"{path}: not a readable .mat file (truncated or of another format)") from error


def _by_frame(value: Any, rows: int, what: str) -> np.ndarray:
    """(F, P, >= rows) from a struct array, a cell array or a matrix with `rows` rows per image."""
    if isinstance(value, np.ndarray) and value.dtype != object:
        if value.ndim != 2 or len(value) % rows:
            raise InputError(f"{what} has shape {value.shape}, expected {rows} rows per image")
        value = np.split(value, len(value) // rows)
    if isinstance(value, Mapping):
        value = [value]
    frames = [_matrix(frame, rows, f"{what} of image {k}") for k, frame in enumerate(value)]
    if len({frame.shape for frame in frames}) > 1:
        counts = sorted({frame.shape[1] for frame in frames})
        raise InputError(f"{what} holds between {counts[0]} and {counts[-1]} points per image, expected equally many")
    return np.stack(frames).transpose(0, 2, 1)


def _matrix(frame: Any, rows: int, what: str) -> np.ndarray:
    """The numbers of one image; a struct must have them as its only matrix with enough rows."""
    parts = list(frame.values()) if isinstance(frame, Mapping) else [frame]
    found = [part for part in parts if isinstance(part, np.ndarray) and part.ndim == 2 and len(part) in (rows, 3)]
    if len(found) != 1 or found[0].dtype.kind not in "fiu":
        raise InputError(f"{what} is not a matrix of numbers with {rows} rows")
    return found[0].astype(np.float64)


def _camera(fields: Mapping[str, Any], source: str) -> np.ndarray:
    for name in ("K", "KK"):
        if name in fields:
            K = np.asarray(fields[name])
            if K.shape != (3, 3):
                raise InputError(f"{source}: '{name}' has shape {K.shape}, expected (3, 3)")
            return K
    raise InputError(f"{source}: field 'K' is missing, expected (3, 3) intrinsics; give --intrinsics fx,fy,cx,cy")


def _visible(value: Any, shape: tuple[int, int], what: str) -> np.ndarray:
    """(F, P) from (P, F), (F, P) or one row per image; points by images where both fit, the more common habit."""
    if isinstance(value, list | tuple) or (isinstance(value, np.ndarray) and value.dtype == object):
        rows = [np.ravel(row["v"] if isinstance(row, Mapping) and "v" in row else row) for row in value]
        if len({len(row) for row in rows}) > 1:
            raise InputError(f"{what} holds rows of different lengths, expected one entry per point")
        array = np.stack(rows)
    else:
        array = np.asarray(value).T
        array = array if array.shape == shape else array.T
    if array.shape != shape or array.dtype.kind not in "biuf":
        raise InputError(
            f"{what} has shape {array.shape}, expected one entry for {shape[0]} images x {shape[1]} points"
        )
    return array != 0
