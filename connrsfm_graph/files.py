"""Files that are either whole or absent, and `.npz` archives read without trust and without more memory than needed.

Everything a run writes goes to a temporary name on the same file system first and is renamed when complete, so an
interrupted run leaves the previous result, or nothing, but never half a result.
"""

from __future__ import annotations

import math
import mmap
import os
import shutil
import struct
import tempfile
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Literal

import numpy as np

from connrsfm_graph.errors import InputError

LARGE = 2**24
"""Bytes from which an array of numbers is stored as it is: zlib takes half a minute a GiB to save a twentieth of it."""
_ALIGNMENT = 64
_PADDING = 0xFFFF
"""Number of a field of the archive that means nothing."""


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


def write_npz(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write an `.npz` that `numpy.load` reads, array by array, so that arrays mapped from disk need little memory.

    Arrays of numbers from `LARGE` on are stored as they are, at aligned places, where `read_npz` maps them; all others
    are compressed. The same arrays give the same bytes.
    """
    with zipfile.ZipFile(path, "w") as archive:
        for name, array in arrays.items():
            entry = zipfile.ZipInfo(f"{name}.npy")
            entry.compress_type = zipfile.ZIP_DEFLATED
            if array.nbytes >= LARGE and array.dtype.kind == "f":
                entry.compress_type = zipfile.ZIP_STORED
                # Header of the entry, its name, 20 bytes for sizes beyond 4 GiB, then a field of zeros as padding.
                start = archive.start_dir + 30 + len(entry.filename) + 20 + 4
                padding = -start % _ALIGNMENT
                entry.extra = struct.pack("<HH", _PADDING, padding) + bytes(padding)
            with archive.open(entry, "w", force_zip64=True) as stream:
                np.lib.format.write_array(stream, np.asanyarray(array), allow_pickle=False)
            release(array)


def read_npz(path: str | Path) -> dict[str, np.ndarray]:
    """All arrays of an `.npz` file; pickled objects are refused, never executed.

    Large arrays that `write_npz` left uncompressed are mapped: they take memory only where they are looked at.

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
                mapped = _mapped(path, archive.zip, f"{field}.npy")
                arrays[field] = archive[field] if mapped is None else mapped
    except ValueError as error:
        if "allow_pickle" in str(error):
            raise InputError(f"{path}: '{field}' holds Python objects, expected an array of numbers") from error
        raise InputError(f"{path}: '{field}' cannot be read as an array") from error
    except (OSError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise InputError(f"{path}: '{field}' is truncated or damaged") from error
    return arrays


def release(array: np.ndarray) -> None:
    """Let go of the memory of an array that is mapped from a file for writing; it is read again where looked at."""
    base: object = array
    while isinstance(base, np.ndarray):
        base = base.base
    if isinstance(array, np.memmap) and array.mode != "c" and isinstance(base, mmap.mmap) and hasattr(base, "madvise"):
        base.madvise(mmap.MADV_DONTNEED)


def _mapped(path: Path, archive: zipfile.ZipFile, name: str) -> np.ndarray | None:
    """An array of an archive mapped from the file, private to this process; None where that is not possible."""
    entry = archive.NameToInfo.get(name)
    if entry is None or entry.compress_type != zipfile.ZIP_STORED or entry.file_size < LARGE:
        return None
    with archive.open(entry) as stream:
        version = np.lib.format.read_magic(stream)
        if version != (1, 0):
            return None
        shape, fortran, dtype = np.lib.format.read_array_header_1_0(stream)
        header = stream.tell()
    with path.open("rb") as file:
        file.seek(entry.header_offset + 26)
        start = entry.header_offset + 30 + sum(struct.unpack("<HH", file.read(4))) + header
    if dtype.hasobject or start % dtype.alignment or math.prod(shape) * dtype.itemsize != entry.file_size - header:
        return None
    order: Literal["F", "C"] = "F" if fortran else "C"
    return np.asarray(np.memmap(path, dtype=dtype, mode="c", offset=start, shape=shape, order=order))


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
