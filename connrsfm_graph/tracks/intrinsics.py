"""Pinhole intrinsics as people write them: four numbers or a 3 x 3 matrix in a text file."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.files import require_file

_EXPECTED = "expected fx,fy,cx,cy or a text file with four numbers or a 3 x 3 matrix"


def parse_intrinsics(text: str | Path) -> np.ndarray:
    """The (3, 3) matrix K, in pixels, of "fx,fy,cx,cy" or of a text file that holds these or nine numbers row by row.

    Raises:
        InputError: neither four numbers nor a readable file, or an impossible camera.
    """
    source = f"intrinsics '{text}'"
    values = _numbers(str(text))
    if values is None:
        path = Path(text)
        if not path.exists():
            raise InputError(f"{source}: neither numbers nor an existing file, {_EXPECTED}")
        require_file(path)
        try:
            content = path.read_text(encoding="utf-8")
        except UnicodeDecodeError as error:
            raise InputError(f"{path}: is not a text file, {_EXPECTED}") from error
        source = str(path)
        values = _numbers(content)
        if values is None:
            raise InputError(f"{source}: holds something other than numbers, {_EXPECTED}")
    if values.size == 4:
        fx, fy, cx, cy = values
        values = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1])
    if values.size != 9:
        raise InputError(f"{source}: holds {values.size} numbers, {_EXPECTED}")
    K = values.reshape(3, 3)
    if not np.isfinite(K).all() or (np.diag(K)[:2] <= 0).any():
        raise InputError(f"{source}: focal lengths {K[0, 0]:g} and {K[1, 1]:g}, expected finite numbers above 0")
    if K[1, 0] != 0 or (K[2] != [0, 0, 1]).any():
        raise InputError(f"{source}: not upper triangular with last row 0 0 1")
    return K


def _numbers(text: str) -> np.ndarray | None:
    """All numbers of a text separated by blanks, commas, semicolons or brackets; None where anything else stands."""
    words = [word for word in re.split(r"[\s,;\[\]]+", text) if word]
    try:
        return np.array([float(word) for word in words]) if words else None
    except ValueError:
        return None
