"""The measured tables into the pages that show them: all into `experiments/README.md`, the summary into `README.md`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from connrsfm_graph.errors import InputError
from experiments.accuracy import write_between_marks

PAGE = Path(__file__).with_name("README.md")
PROJECT_PAGE = PAGE.parents[1] / "README.md"
RESULTS = ("<!-- results -->", "<!-- /results -->")
SUMMARY = ("<!-- summary -->", "<!-- /summary -->")


def publish(out: Path, names: Sequence[str], page: Path = PAGE, project_page: Path = PROJECT_PAGE) -> None:
    """Write NAME.md of every named experiment between the marks of the pages, as far as it was measured.

    Raises:
        InputError: nothing was measured yet, or a page has no marks.
    """
    tables = {name: out / f"{name}.md" for name in ["summary", *(name for name in names if name != "summary")]}
    measured = {name: path.read_text(encoding="utf-8").strip() for name, path in tables.items() if path.exists()}
    if "summary" not in measured:
        raise InputError(f"{out}: holds no summary.md; run python -m experiments all first")
    parts = [f"`python -m experiments {name}`\n\n{_without_heading(text)}\n" for name, text in measured.items()]
    write_between_marks(page, "\n" + "\n".join(parts) + "\n", RESULTS)
    write_between_marks(project_page, f"\n{_without_heading(measured['summary'])}\n\n", SUMMARY)


def _without_heading(text: str) -> str:
    """The first line in bold instead of as a heading: the pages have headings of their own."""
    first, newline, rest = text.partition("\n")
    return f"**{first.lstrip('# ')}**{newline}{rest}" if first.startswith("#") else text
