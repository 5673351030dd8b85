"""What the experiments share: cases that are run once each, and the table and figure made of their results.

A case is one run of one method on one set of tracks, named by its keys (data, method, noise, seed, ...). Results are
rows of a CSV file: a case whose keys stand there already is not run again, so that an interrupted experiment goes on
where it was. Rows that differ in the seed alone are averaged in the Markdown table and the figure, which are rewritten
after every run. To measure again, delete the CSV file.
"""

from __future__ import annotations

import csv
import math
import statistics
import sys
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from functools import cache
from pathlib import Path
from typing import Any

import numba

from connrsfm_graph.cli.evaluate import evaluated
from connrsfm_graph.config import override
from connrsfm_graph.errors import ComputationError, InputError
from connrsfm_graph.files import written_beside
from connrsfm_graph.methods import METHODS
from connrsfm_graph.progress import Progress
from connrsfm_graph.reconstruct import Config, default_config
from connrsfm_graph.synthetic import spheres
from connrsfm_graph.tracks import Tracks

MEASURES = ("e3d_percent", "shape_error_deg", "rmse_3d_percent", "coverage", "seconds")
"""Columns of results, empty where a run failed."""
THREADS = numba.get_num_threads()
"""Threads at hand."""
SEED, FAILURE = "seed", "failure"
VARIANTS: dict[str, tuple[str, Config]] = {
    "default": ("connrsfm", default_config()),
    "paper mode": ("connrsfm", default_config("paper")),
    **{name: (name, default_config()) for name in METHODS if name != "connrsfm"},
}
"""What tables call a method: our two modes and the baselines."""


@dataclass(frozen=True)
class Options:
    """What the command line decides."""

    data: Path
    """Folder of the data sets."""
    out: Path
    """Folder for results."""
    quick: bool = False
    """Whether to run a small part of every experiment."""

    def seeds(self) -> range:
        """Seeds of random experiments: five, or one of a quick run."""
        return range(1 if self.quick else 5)


@dataclass(frozen=True)
class Case:
    """One run."""

    keys: Mapping[str, Any]
    """Column name to value; all cases of an experiment have the same columns."""
    tracks: Callable[[], Tracks]
    """Makes or loads the tracks, with truth."""
    method: str = "connrsfm"
    """Name in the registry of methods."""
    config: Config = field(default_factory=Config)
    """Settings of the run."""
    threads: int | None = None
    """Threads of the compiled kernels; all where None."""


@dataclass(frozen=True)
class Experiment:
    """One table and one figure."""

    name: str
    """Name on the command line and of the files."""
    title: str
    """Headline of table and figure."""
    cases: Callable[[Options], Iterable[Case]]
    """What to run; nothing where the data are absent."""
    x: str | None = None
    """Column along the figure's horizontal axis; bars by group where None."""
    measure: str = "e3d_percent"
    """Column along its vertical axis."""
    published: Mapping[tuple[str, ...], str] = field(default_factory=dict)
    """Published 3D error in percent / shape error in degrees, by a group's keys as they stand in the table."""

    def __call__(self, options: Options) -> None:
        """Run what is missing, then write NAME.csv, NAME.md and NAME.png."""
        options.out.mkdir(parents=True, exist_ok=True)
        path = options.out / f"{self.name}.csv"
        cases = list(self.cases(options))
        if not cases:
            print(f"{self.name}: skipped, its data are not in {options.data}", file=sys.stderr)
            return
        rows = read_rows(path)
        done = {_identity(row, cases[0].keys) for row in rows}
        missing = [case for case in cases if _identity(case.keys, case.keys) not in done]
        if missing:
            compile_kernels()
        for count, case in enumerate(missing, 1):
            named = ", ".join(f"{key} {value}" for key, value in case.keys.items())
            print(f"{self.name} {count}/{len(missing)}: {named}", end=" ", file=sys.stderr, flush=True)
            row = run(case)
            rows.append(row)
            append_row(path, row)
            print(row[FAILURE] or f"{row['e3d_percent']} % in {row['seconds']} s", file=sys.stderr)
        wanted = {_identity(case.keys, case.keys) for case in cases}
        groups = group([row for row in rows if _identity(row, cases[0].keys) in wanted], tuple(cases[0].keys))
        text = markdown(self, groups)
        (options.out / f"{self.name}.md").write_text(text, encoding="utf-8")
        print(text)
        from experiments.figure import draw

        draw(self, groups, options.out / f"{self.name}.png")


@dataclass(frozen=True)
class Group:
    """Runs that differ in their seed alone."""

    keys: Mapping[str, str]
    """Column to value, without the seed."""
    runs: int
    """How many succeeded."""
    mean: Mapping[str, float]
    """Mean of every measure over the runs that succeeded; NaN where none did."""
    spread: Mapping[str, float]
    """Standard deviation over the runs; 0 for a single one."""
    failures: tuple[str, ...]
    """Why the others failed."""


@cache
def compile_kernels() -> None:
    """Run both modes once on a small scene, with an image that follows keyframes, so that no compilation is timed."""
    tracks = spheres(n_frames=6, n_points=30).tracks
    for name in ("default", "paper mode"):
        method, config = VARIANTS[name]
        METHODS[method](tracks, override(config, ["keyframes.most=5"]), Progress())  # the last image follows them


def run(case: Case) -> dict[str, str]:
    """Run a case and evaluate it; a failure of the method is a result, too."""
    row = {key: _text(value) for key, value in case.keys.items()}
    tracks = case.tracks()
    numba.set_num_threads(case.threads or THREADS)
    start = time.perf_counter()
    try:
        reconstruction, _ = METHODS[case.method](tracks, case.config, Progress())
    except (ComputationError, InputError) as error:
        return row | dict.fromkeys(MEASURES, "") | {FAILURE: str(error)}
    seconds = time.perf_counter() - start
    errors, _ = evaluated(reconstruction, tracks, "an experiment's tracks")
    figures = {name: getattr(errors, name) for name in MEASURES if name != "seconds"} | {"seconds": seconds}
    return row | {name: f"{value:.4g}" for name, value in figures.items()} | {FAILURE: ""}


def read_rows(path: Path) -> list[dict[str, str]]:
    """The rows written so far; none where there is no file."""
    if not path.exists():
        return []
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def append_row(path: Path, row: Mapping[str, str]) -> None:
    """Add a row, and the header before the first one; written at once, so that an interruption loses nothing."""
    new = not path.exists()
    with path.open("a", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(row))
        if new:
            writer.writeheader()
        writer.writerow(row)


def save(path: Path, rows: Sequence[Any]) -> None:
    """A table of dataclass instances of one kind, at least one, as CSV."""
    with written_beside(path) as part, part.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [column.name for column in fields(rows[0])])
        writer.writeheader()
        writer.writerows(asdict(row) for row in rows)


def group(rows: Sequence[Mapping[str, str]], columns: Sequence[str]) -> list[Group]:
    """Runs gathered by all keys but the seed, in order of first appearance."""
    names = [name for name in columns if name != SEED]
    gathered: dict[tuple[str, ...], list[Mapping[str, str]]] = {}
    for row in rows:
        gathered.setdefault(tuple(row[name] for name in names), []).append(row)
    groups = []
    for values, members in gathered.items():
        good = [row for row in members if not row[FAILURE]]
        series = {name: [float(row[name]) for row in good] for name in MEASURES}
        groups.append(
            Group(
                keys=dict(zip(names, values, strict=True)),
                runs=len(good),
                mean={name: statistics.fmean(found) if found else math.nan for name, found in series.items()},
                spread={name: statistics.stdev(found) if len(found) > 1 else 0.0 for name, found in series.items()},
                failures=tuple(row[FAILURE] for row in members if row[FAILURE]),
            )
        )
    return groups


def markdown(experiment: Experiment, groups: Sequence[Group]) -> str:
    """The table: one line per group, ours and the published figure side by side."""
    names = list(groups[0].keys)
    head = [*names, "runs", "3D error %", "shape error deg", "coverage", "seconds", "published % / deg"]
    lines = [f"### {experiment.title}", "", _line(head), _line(["---"] * len(head))]
    for each in groups:
        published = experiment.published.get(tuple(each.keys.values()), "")
        if each.runs:
            figures = [
                with_spread(each, "e3d_percent", 3),
                with_spread(each, "shape_error_deg", 2),
                f"{each.mean['coverage']:.2f}",
                f"{each.mean['seconds']:.1f}",
            ]
        else:
            figures = ["fails", "", "", ""]
        lines.append(_line([*each.keys.values(), f"{each.runs}/{each.runs + len(each.failures)}", *figures, published]))
    return "\n".join(lines) + "\n"


def with_spread(each: Group, measure: str, digits: int) -> str:
    """Mean and standard deviation of a measure."""
    text = f"{each.mean[measure]:.{digits}f}"
    return text if each.runs < 2 else f"{text} ± {each.spread[measure]:.{digits}f}"


def _line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cells)} |"


def _identity(values: Mapping[str, Any], columns: Iterable[str]) -> tuple[str, ...]:
    return tuple(_text(values[name]) for name in columns)


def _text(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
