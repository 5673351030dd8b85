"""Tracks from and to files: `.npz`, the `.mat` layouts of public NRSfM code, and CSV.

The name's ending decides the format. Whatever a file holds is checked before it is used: numbers only, shapes that fit
each other, finite where visible; pickled objects are refused, never executed.
"""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.files import read_npz, require_file, written_beside
from connrsfm_graph.tracks.intrinsics import parse_intrinsics
from connrsfm_graph.tracks.matlab import read_mat
from connrsfm_graph.tracks.table import read_csv
from connrsfm_graph.tracks.tracks import Tracks
from factors.surface import PERSPECTIVE

MAX_BYTES = 8 * 2**30
"""Largest array content a file may declare; beyond that it is taken for damaged rather than read."""


def load_tracks(
    path: str | Path, intrinsics: str | Path | np.ndarray | None = None, camera: str | None = None
) -> Tracks:
    """Read tracks from a file.

    Args:
        path: `.npz` with `tracks`, `K` and optionally `visible`, `points`, `normals`, `image_names`, `camera`;
            `.mat` (`connrsfm_graph.tracks.matlab` lists the layouts); or `.csv` with columns frame, point, x, y.
        intrinsics: (3, 3) matrix, "fx,fy,cx,cy" or the path of a text file with either; overrides the file's own and
            is needed where the file has none.
        camera: `perspective` or `orthographic`, overrides the file's own; perspective where neither says.

    Raises:
        InputError: one sentence that names the file, the field and what was expected.
    """
    path = Path(path)
    require_file(path)
    K = parse_intrinsics(intrinsics) if isinstance(intrinsics, str | Path) else intrinsics
    if path.stat().st_size == 0:
        raise InputError(f"{path}: is empty, expected tracks")
    match path.suffix.lower():
        case ".npz":
            return _read_npz(path, K, camera)
        case ".mat":
            return read_mat(path, K, camera or PERSPECTIVE.name)
        case ".csv" | ".txt":
            return read_csv(path, K, camera or PERSPECTIVE.name)
        case suffix:
            raise InputError(f"{path}: unknown ending '{suffix}', expected .npz, .mat or .csv")


def save_tracks(path: str | Path, tracks: Tracks) -> None:
    """Write an `.npz` that `load_tracks` reads back unchanged; the file appears whole or not at all."""
    path = Path(path)
    if path.suffix.lower() != ".npz":
        raise InputError(f"{path}: unknown ending '{path.suffix}', expected .npz")
    same_camera = bool((tracks.K[0] == tracks.K).all())
    arrays = {
        "tracks": tracks.pixels,
        "K": tracks.K[0] if same_camera else tracks.K,
        "visible": tracks.visible,
        "points": tracks.points,
        "normals": tracks.normals,
        "image_names": None if tracks.image_names is None else np.array(tracks.image_names),
        "camera": None if tracks.camera is PERSPECTIVE else np.array(tracks.camera.name),
    }
    with written_beside(path) as part, part.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **{k: v for k, v in arrays.items() if v is not None})


def _read_npz(path: Path, K: np.ndarray | None, camera: str | None) -> Tracks:
    _refuse_huge(path)
    try:
        arrays = read_npz(path)
    except MemoryError as error:
        raise InputError(f"{path}: declares arrays larger than the memory (damaged, or not a tracks file)") from error
    if "tracks" not in arrays:
        found = ", ".join(f"'{name}'" for name in arrays) or "nothing"
        raise InputError(f"{path}: field 'tracks' is missing, expected (frames, points, 2) pixels; found {found}")
    if K is None and "K" not in arrays:
        raise InputError(f"{path}: field 'K' is missing, expected (3, 3) intrinsics; add it or give --intrinsics")
    names = arrays.get("image_names")
    if names is not None and (names.ndim != 1 or names.dtype.kind != "U"):
        raise InputError(f"{path}: 'image_names' is not a list of names")
    if camera is None:
        camera = str(arrays.get("camera", PERSPECTIVE.name))
    return Tracks.checked(
        pixels=arrays["tracks"],
        K=arrays["K"] if K is None else K,
        visible=arrays.get("visible"),
        points=arrays.get("points"),
        normals=arrays.get("normals"),
        image_names=None if names is None else names.tolist(),
        camera=camera,
        source=str(path),
    )


def _refuse_huge(path: Path) -> None:
    """A small archive may unpack to more than the memory; its table of contents says so beforehand."""
    if not zipfile.is_zipfile(path):
        return  # read_npz says what it is not
    with zipfile.ZipFile(path) as archive:
        size = sum(entry.file_size for entry in archive.infolist())
    if size > MAX_BYTES:
        raise InputError(f"{path}: unpacks to {size / 2**30:.0f} GiB, expected at most {MAX_BYTES / 2**30:.0f} GiB")
