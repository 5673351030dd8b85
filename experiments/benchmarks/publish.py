"""The measured benchmarks into their pages: tables into `experiments/README.md`, sentences into `README.md`.

No figure of these pages is written by hand.
"""

from __future__ import annotations

from pathlib import Path

from connrsfm_graph.errors import InputError
from experiments.accuracy import write_between_marks
from experiments.benchmarks.table import Row, Table
from experiments.publish import PAGE, PROJECT_PAGE

MARKS = ("<!-- benchmarks -->", "<!-- /benchmarks -->")
NAMES = ("pipeline", "parallel", "iteration")


def publish(out: Path, page: Path = PAGE, project_page: Path = PROJECT_PAGE) -> None:
    """Write NAME.md of every benchmark that was measured, and what the project's page says of them.

    Args:
        out: folder of the measurements.
        page, project_page: Markdown files with the marks.

    Raises:
        InputError: nothing was measured, or a page has no marks.
    """
    files = {name: out / f"{name}.md" for name in NAMES}
    measured = {name: file.read_text(encoding="utf-8").strip() for name, file in files.items() if file.exists()}
    if not measured:
        raise InputError(f"{out}: holds no benchmark; run python -m experiments.benchmarks first")
    parts = [f"`python -m experiments.benchmarks {name}`: {text}\n" for name, text in measured.items()]
    write_between_marks(page, "\n" + "\n".join(parts) + "\n", MARKS)
    write_between_marks(project_page, _iteration(out) + _pipeline(out), MARKS)


def _iteration(out: Path) -> str:
    """A sentence on one joint iteration; empty where it was not measured."""
    rows = {row["solver"]: row for row in _rows(out, "iteration") if row["iteration"] == "joint"}
    if not {"batched", "GTSAM", "scipy TRF per point"} <= set(rows):
        return ""
    batched = rows["batched"]
    return (
        f"- One joint iteration over {batched['images']} images x {batched['points']} points "
        "(`python -m experiments.benchmarks iteration`):\n"
        f"  batched {float(batched['seconds']):.3f} s; linearise and eliminate in GTSAM "
        f"{float(rows['GTSAM']['times batched']):.0f} times, scipy's TRF per point "
        f"{float(rows['scipy TRF per point']['times batched']):.0f} times that.\n"
    )


def _pipeline(out: Path) -> str:
    """A sentence on whole reconstructions; empty where none was measured."""
    rows = _rows(out, "pipeline")
    if not rows:
        return ""
    times = [f"{row['images']} x {row['points']} in {_duration(float(row['seconds']))}" for row in rows]
    memory = max(float(row["peak MiB"]) for row in rows) / 1024
    error = max(float(row["3D error %"]) for row in rows)
    return (
        "- Tracks to points of sheets with exact truth (`python -m experiments.benchmarks pipeline`):\n"
        f"  {', '.join(times)};\n"
        f"  at most {memory:.1f} GiB of memory and {error:.4f} % of 3D error.\n"
    )


def _rows(out: Path, name: str) -> list[Row]:
    return [row for row in Table(out, name, ()).rows if not row["failure"]]


def _duration(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds < 100 else f"{seconds / 60:.0f} minutes"
