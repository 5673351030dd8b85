"""Files are whole or absent, and archives are read without more memory than needed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from connrsfm_graph import files
from connrsfm_graph.errors import InputError
from connrsfm_graph.files import (
    check_output_folder,
    folder_written_beside,
    read_npz,
    release,
    write_npz,
    written_beside,
)


def test_failed_write_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "x.txt"
    path.write_text("old")

    def interrupted() -> None:
        with written_beside(path) as part:
            part.write_text("half")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert [entry.name for entry in tmp_path.iterdir()] == ["x.txt"]
    assert path.read_text() == "old"
    with written_beside(path) as part:
        part.write_text("new")
    assert path.read_text() == "new"


def test_failed_folder_leaves_nothing_not_even_parents(tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"

    def failing() -> None:
        with folder_written_beside(out) as part:
            (part / "x").write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        failing()
    assert list(tmp_path.iterdir()) == []


def test_folder_replaces_its_own_entries_and_keeps_others(tmp_path: Path) -> None:
    out = tmp_path / "a" / "b"
    for text in ("first", "second"):
        with folder_written_beside(out) as part:
            (part / "pictures").mkdir()
            (part / "pictures" / f"{text}.png").write_text(text)
            (part / "page").write_text(text)
        (out / "mine").write_text("kept")
    assert sorted(entry.name for entry in out.iterdir()) == ["mine", "page", "pictures"]
    assert [entry.name for entry in (out / "pictures").iterdir()] == ["second.png"]
    assert (out / "page").read_text() == "second"


def test_output_that_is_a_file_or_below_one_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="is a file; expected a folder"):
        check_output_folder(tmp_path / "file")
    with pytest.raises(InputError, match="is a file; expected a folder"):
        check_output_folder(tmp_path / "file" / "below")
    with pytest.raises(InputError, match="is a folder, expected the name of a file"), written_beside(tmp_path):
        pass


def test_large_arrays_are_mapped_and_numpy_reads_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(files, "LARGE", 1000)
    path = tmp_path / "x.npz"
    rng = np.random.default_rng(0)
    arrays = {
        "small": rng.normal(size=5),
        "large": rng.normal(size=(40, 7)),
        "fortran": np.asfortranarray(rng.normal(size=(40, 7))),
        "flags": rng.uniform(size=2000) < 0.5,
        "name": np.array("x"),
    }
    write_npz(path, arrays)
    written = path.read_bytes()
    found = read_npz(path)
    with np.load(path, allow_pickle=False) as archive:
        assert archive.zip.testzip() is None
        for name, array in arrays.items():
            np.testing.assert_array_equal(archive[name], array)
            np.testing.assert_array_equal(found[name], array)
            mapped = isinstance(found[name].base, np.memmap)
            assert mapped == (name in ("large", "fortran"))
            assert found[name].flags.aligned
    found["large"][:] = 0.0  # of this process alone
    write_npz(tmp_path / "again.npz", arrays)
    assert (tmp_path / "again.npz").read_bytes() == path.read_bytes() == written


def test_memory_of_a_mapped_array_is_released_and_its_content_kept(tmp_path: Path) -> None:
    array = np.lib.format.open_memmap(tmp_path / "x.npy", mode="w+", dtype=float, shape=(1000,))
    array[:] = np.arange(1000)
    release(array)
    assert array[-1] == 999
    assert np.load(tmp_path / "x.npy")[-1] == 999
    release(np.zeros(3))  # nothing to do
