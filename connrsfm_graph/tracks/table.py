"""Tracks as a table: one line per observation with columns frame, point, x, y."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.tracks.tracks import Tracks
from factors.surface import PERSPECTIVE

_COLUMNS = ("frame", "point", "x", "y")
_MAX_ENTRIES = 200_000_000


def read_csv(path: Path, K: np.ndarray | None, camera: str = PERSPECTIVE.name) -> Tracks:
    """Read a comma-separated table whose first line names at least the columns frame, point, x and y.

    Frame and point numbers may start anywhere and have gaps: the images and points are those that occur, in ascending
    order, and the frame's number becomes the image's name. Pixels: x right, y down, 0-based.

    Raises:
        InputError: no intrinsics given, a column missing, or a line that cannot be read or says something twice.
    """
    if K is None:
        raise InputError(f"{path}: a table of tracks has no camera, give --intrinsics fx,fy,cx,cy or a 3 x 3 text file")
    ids, pixels, lines = _rows(path)
    frames, frame = np.unique(ids[:, 0], return_inverse=True)
    points, point = np.unique(ids[:, 1], return_inverse=True)
    if len(frames) * len(points) > _MAX_ENTRIES:
        raise InputError(f"{path}: {len(frames)} frames with {len(points)} points are more than can be held at once")
    entry = frame * len(points) + point
    _, first = np.unique(entry, return_index=True)
    if len(first) < len(entry):
        again = np.setdiff1d(np.arange(len(entry)), first)[0]
        raise InputError(
            f"{path}: line {lines[again]} gives frame {ids[again, 0]}, point {ids[again, 1]} a second time"
        )
    tracks = np.full((len(frames), len(points), 2), np.nan)
    tracks[frame, point] = pixels
    names = [f"frame {number}" for number in frames]
    return Tracks.checked(tracks, K, image_names=names, camera=camera, source=str(path))


def _rows(path: Path) -> tuple[np.ndarray, np.ndarray, list[int]]:
    """Frame and point numbers (N, 2) int, pixels (N, 2), and the line each stands on."""
    ids: list[tuple[int, int]] = []
    pixels: list[tuple[float, float]] = []
    lines: list[int] = []
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.reader(stream)
            header = [name.strip().lower() for name in next(reader, [])]
            missing = [name for name in _COLUMNS if name not in header]
            if missing:
                raise InputError(
                    f"{path}: column '{missing[0]}' is missing, expected a first line with {','.join(_COLUMNS)}"
                )
            columns = [header.index(name) for name in _COLUMNS]
            for row in reader:
                if not row:
                    continue
                try:
                    f, p, x, y = (row[column] for column in columns)
                    ids.append((_index(f), _index(p)))
                    pixels.append((_pixel(x), _pixel(y)))
                except (ValueError, IndexError):
                    shown = " ".join(",".join(row).split())[:60]
                    raise InputError(
                        f"{path}: line {reader.line_num} is '{shown}', expected two whole numbers and "
                        "two pixel coordinates"
                    ) from None
                lines.append(reader.line_num)
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: is not a comma-separated text file") from error
    if not ids:
        raise InputError(f"{path}: holds no observation below its first line")
    return np.array(ids, dtype=np.int64), np.array(pixels), lines


def _index(text: str) -> int:
    number = int(text)
    if not -(2**63) <= number < 2**63:
        raise ValueError(f"{number} is too large for an index")
    return number


def _pixel(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{number} is no coordinate; leave the line out where a point is not visible")
    return number
