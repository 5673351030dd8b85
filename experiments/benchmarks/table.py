"""A table of measurements that grows row by row: `NAME.csv`, and `NAME.md` with the machine it was measured on.

A row that is there is not measured again, so that an interrupted benchmark goes on where it was. To compare figures
with each other they must be of one run: delete the files to measure again.
"""

from __future__ import annotations

import csv
import os
import platform
from collections.abc import Callable, Mapping
from functools import cache
from importlib import metadata
from pathlib import Path

Row = dict[str, str | int | float]
Columns = Mapping[str, Callable[[Row], str]]
"""What a column of the Markdown table shows of a row."""
FAILURE = "failure"


class Table:
    """Rows by the values of their key columns."""

    def __init__(self, folder: Path, name: str, keys: tuple[str, ...]) -> None:
        self.rows: list[Row] = []
        self._folder, self._name, self._keys = folder, name, keys
        if (path := folder / f"{name}.csv").exists():
            with path.open(newline="", encoding="utf-8") as file:
                self.rows = [{column: _read(text) for column, text in row.items()} for row in csv.DictReader(file)]

    def measure(self, keys: Row, work: Callable[[], Mapping[str, str | int | float]]) -> None:
        """Add a row, unless there is one of these keys; what goes wrong is its result, and measured again next time."""
        if any(all(row[key] == value for key, value in keys.items()) and not row.get(FAILURE) for row in self.rows):
            return
        print(f"{self._name}: {', '.join(f'{value} {key}' for key, value in keys.items())}", flush=True)
        try:
            row: Row = {**keys, **work(), FAILURE: ""}
        except (RuntimeError, ValueError, OSError) as error:
            row = {**keys, FAILURE: " ".join(str(error).split())[-200:]}
            print(f"  failed: {row[FAILURE]}", flush=True)
        self.rows = [old for old in self.rows if any(old[key] != value for key, value in keys.items())] + [row]

    def write(self, columns: Columns) -> None:
        """Write the rows, and as Markdown what `columns` make of them; a failed row shows its keys and why."""
        self._folder.mkdir(parents=True, exist_ok=True)
        names = [*dict.fromkeys(name for row in self.rows for name in row if name != FAILURE), FAILURE]
        with (self._folder / f"{self._name}.csv").open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, names, restval="")
            writer.writeheader()
            writer.writerows(self.rows)
        lines = [machine(), "", "| " + " | ".join(columns) + " |", "|" + " --- |" * len(columns)]
        for row in self.rows:
            if failure := row.get(FAILURE):
                cells = [str(row[key]) for key in self._keys] + [str(failure)]
                cells += [""] * (len(columns) - len(cells))
            else:
                cells = [cell(row) for cell in columns.values()]
            lines.append("| " + " | ".join(cells) + " |")
        (self._folder / f"{self._name}.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


def cores() -> int:
    """Processors at hand."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def machine() -> str:
    """The machine in a line."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        names = [line.partition(":")[2].strip() for line in cpuinfo.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    versions = ", ".join(f"{name} {metadata.version(name)}" for name in ("numpy", "scipy", "numba", "gtsam"))
    return f"{model}, {cores()} cores, {memory:.0f} GiB, {gpu()}; Python {platform.python_version()}, {versions}"


@cache
def gpu() -> str:
    """The graphics processor that torch would use, or that there is none."""
    try:
        import torch
    except ImportError:
        return "no torch and so no GPU"
    return torch.cuda.get_device_name() if torch.cuda.is_available() else "no GPU"


def _read(text: str) -> str | int | float:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text
