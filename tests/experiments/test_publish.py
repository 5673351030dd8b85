"""Measured tables go between the marks of the pages, and nowhere else."""

from __future__ import annotations

from pathlib import Path

import pytest

from connrsfm_graph.errors import InputError
from experiments.publish import PAGE, PROJECT_PAGE, RESULTS, SUMMARY, publish


def page(path: Path, marks: tuple[str, str]) -> Path:
    path.write_text(f"before\n{marks[0]}\nold\n{marks[1]}\nafter\n")
    return path


def test_tables_replace_the_old_ones(tmp_path: Path) -> None:
    results, project = page(tmp_path / "page.md", RESULTS), page(tmp_path / "project.md", SUMMARY)
    (tmp_path / "summary.md").write_text("### All\n\n| a |\n")
    (tmp_path / "spheres.md").write_text("### Spheres\n\n| b |\n")
    publish(tmp_path, ["spheres", "flag", "summary"], results, project)
    text = results.read_text()
    assert text.startswith("before\n")
    assert text.endswith("after\n")
    assert "old" not in text
    assert text.index("experiments summary`\n\n**All**") < text.index("experiments spheres`\n\n**Spheres**\n\n| b |")
    assert "flag" not in text
    assert "**All**\n\n| a |" in project.read_text()
    assert "| b |" not in project.read_text()
    once = text
    publish(tmp_path, ["spheres", "flag", "summary"], results, project)
    assert results.read_text() == once


def test_nothing_measured_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no summary"):
        publish(tmp_path, ["spheres"])


def test_the_pages_hold_the_marks() -> None:
    for path, marks in ((PAGE, RESULTS), (PROJECT_PAGE, SUMMARY)):
        text = path.read_text(encoding="utf-8")
        assert text.count(marks[0]) == text.count(marks[1]) == 1
