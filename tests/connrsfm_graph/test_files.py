"""Files are whole or absent."""

from __future__ import annotations

from pathlib import Path

import pytest

from connrsfm_graph.errors import InputError
from connrsfm_graph.files import check_output_folder, folder_written_beside, written_beside


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
