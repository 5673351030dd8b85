"""Files that are either whole or absent, and `.npz` archives read without trust.

Everything a run writes goes to a temporary name on the same file system first and is renamed when complete, so an
interrupted run leaves the previous result, or nothing, but never half a result.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from connrsfm_graph.errors import InputError


@contextmanager
def written_beside(path: str | Path) -> Iterator[Path]:
    """A temporary path beside `path`, renamed to it when the block ends well and removed when it does not."""
    path = Path(path)
    check_output_folder(path.parent)
    if path.is_dir():
        raise InputError(f"{path}: is a folder, expected the name of a file to write")
    with tempfile.TemporaryDirectory(dir=_nearest_existing(path.parent), prefix=".partial-") as folder:
        part = Path(folder) / path.name
        yield part
        path.parent.mkdir(parents=True, exist_ok=True)
        os.replace(part, path)


def check_output_folder(out: str | Path) -> Path:
    """`out` as a path where a folder exists or can be made.

    Raises:
        InputError: it, or one of its parents, is a file, or the folder cannot be written.
    """
    out = Path(out)
    existing = _nearest_existing(out)
    if not existing.is_dir():
        raise InputError(f"{out}: cannot write there because {existing} is a file; expected a folder or a new name")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise InputError(f"{out}: no permission to write in {existing}")
    return out


@contextmanager
def folder_written_beside(out: str | Path) -> Iterator[Path]:
    """A temporary folder whose entries replace those of the same name in `out` when the block ends well.

    Entries of `out` with other names stay. Nothing is created where the block fails, not even parents of `out`.
    """
    out = check_output_folder(out)
    with tempfile.TemporaryDirectory(dir=_nearest_existing(out), prefix=".partial-") as folder:
        yield Path(folder)
        out.mkdir(parents=True, exist_ok=True)
        for part in sorted(Path(folder).iterdir()):
            target = out / part.name
            if target.is_dir():
                shutil.rmtree(target)
            os.replace(part, target)


def read_npz(path: str | Path) -> dict[str, np.ndarray]:
    """All arrays of an `.npz` file; pickled objects are refused, never executed.

    Raises:
        InputError: the path is missing or a folder, the file is truncated or no archive, or holds object arrays.
    """
    path = Path(path)
    require_file(path)
    if not zipfile.is_zipfile(path):
        raise InputError(f"{path}: not a readable .npz archive (truncated or of another format)")
    arrays = {}
    field = "archive"
    try:
        with np.load(path, allow_pickle=False) as archive:
            for field in archive.files:
                arrays[field] = archive[field]
    except ValueError as error:
        if "allow_pickle" in str(error):
            raise InputError(f"{path}: '{field}' holds Python objects, expected an array of numbers") from error
        raise InputError(f"{path}: '{field}' cannot be read as an array") from error
    except (OSError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path}: '{field}' is truncated or damaged") from error
    return arrays


def require_file(path: Path) -> None:
    """Raise `InputError` where `path` is not a file that can be read."""
    if path.is_dir():
        raise InputError(f"{path}: is a folder, expected a file")
    if not path.exists():
        raise InputError(f"{path}: no such file")
    if not os.access(path, os.R_OK):
        raise InputError(f"{path}: no permission to read it")


def _nearest_existing(path: Path) -> Path:
    path = path.absolute()
    return next(candidate for candidate in (path, *path.parents) if candidate.exists())
