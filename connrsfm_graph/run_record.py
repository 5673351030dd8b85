"""The record of how a reconstruction came about (`run.json`)."""

from __future__ import annotations

import json
import platform
import re
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field, fields, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.files import require_file, written_beside

RECORD_FILE = "run.json"


@dataclass(frozen=True)
class RunRecord:
    """How a reconstruction came about, enough to repeat it and to judge it."""

    source: str
    """The tracks' file or how they were made."""
    method: str
    """Name in the registry of methods."""
    seed: int
    """Seed of every random choice."""
    configuration: dict[str, Any] = field(default_factory=dict)
    """The resolved configuration, nested by stage."""
    decisions: dict[str, Any] = field(default_factory=dict)
    """What was chosen from the data (noise levels, smoothing, model), by name."""
    warnings: tuple[str, ...] = ()
    """One sentence each, for the user."""
    cost_history: dict[str, list[float]] = field(default_factory=dict)
    """Cost after each iteration, by stage."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall-clock seconds of each stage."""
    peak_memory_mib: float = 0.0
    """Largest resident memory of the run's processes, added up, in MiB."""
    versions: dict[str, str] = field(default_factory=dict)
    """Versions of Python and of the packages that compute."""

    def save(self, path: str | Path) -> None:
        """Write `run.json`; numbers JSON cannot express (NaN, infinity) become null."""
        text = json.dumps(_plain(asdict(self)), indent=2, allow_nan=False)
        with written_beside(path) as part:
            part.write_text(text + "\n", encoding="utf-8")

    @staticmethod
    def load(path: str | Path) -> RunRecord:
        """Read `run.json`, or the folder that holds it; keys this version does not know are ignored.

        Raises:
            InputError: the file cannot be read, lacks a key or holds something of the wrong type.
        """
        path = Path(path)
        path = path / RECORD_FILE if path.is_dir() else path
        require_file(path)
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
        except (UnicodeDecodeError, json.JSONDecodeError) as error:
            raise InputError(f"{path}: not a JSON file (truncated or of another format)") from error
        if not isinstance(content, dict):
            raise InputError(f"{path}: holds no JSON object; expected a {RECORD_FILE} written by 'reconstruct'")
        for name in ("source", "method", "seed"):
            if name not in content:
                raise InputError(f"{path}: key '{name}' is missing; expected a {RECORD_FILE} written by 'reconstruct'")
        known = {item.name: content[item.name] for item in fields(RunRecord) if item.name in content}
        for name, value in known.items():
            fits, expected = _RECORD[name]
            if not fits(value):
                raise InputError(
                    f"{path}: '{name}' is not {expected}; expected a {RECORD_FILE} written by 'reconstruct'"
                )
        record = RunRecord(**{**known, "warnings": tuple(known.get("warnings", ()))})
        return replace(
            record,
            cost_history={stage: [_number(cost) for cost in costs] for stage, costs in record.cost_history.items()},
            seconds={stage: _number(value) for stage, value in record.seconds.items()},
            peak_memory_mib=_number(record.peak_memory_mib),
        )


def _number(value: float | None) -> float:
    """A figure as it stands in JSON, where null says that it is none."""
    return float("nan") if value is None else float(value)


def _is_number(value: Any) -> bool:
    return value is None or (isinstance(value, int | float) and not isinstance(value, bool))


def _is_text(value: Any) -> bool:
    return isinstance(value, str)


def _is_table(value: Any) -> bool:
    return isinstance(value, dict)


# What the keys of the record must hold, and how to say it.
_RECORD: dict[str, tuple[Callable[[Any], bool], str]] = {
    "source": (_is_text, "a text"),
    "method": (_is_text, "a text"),
    "seed": (lambda value: isinstance(value, int) and not isinstance(value, bool), "a whole number"),
    "configuration": (_is_table, "a table of settings"),
    "decisions": (_is_table, "a table of decisions"),
    "warnings": (lambda value: isinstance(value, list) and all(map(_is_text, value)), "a list of sentences"),
    "cost_history": (
        lambda value: (
            isinstance(value, dict)
            and all(isinstance(costs, list) and all(map(_is_number, costs)) for costs in value.values())
        ),
        "a table of lists of numbers",
    ),
    "seconds": (lambda value: isinstance(value, dict) and all(map(_is_number, value.values())), "a table of numbers"),
    "peak_memory_mib": (_is_number, "a number"),
    "versions": (lambda value: isinstance(value, dict) and all(map(_is_text, value.values())), "a table of texts"),
}


def package_versions() -> dict[str, str]:
    """Versions of Python and of the packages that compute."""
    names = ("connrsfm-graph", "gtsam", "numpy", "scipy", "numba", "networkx", "opencv-python-headless")
    found = {"python": platform.python_version()}
    for name in names:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


def peak_memory_mib() -> float:
    """Largest resident memory of this process so far, in MiB; NaN on systems that do not tell."""
    if sys.platform == "win32":
        return float("nan")
    with suppress(OSError):
        # On Linux `getrusage` also counts what the process was before it became this program.
        status = Path("/proc/self/status").read_text(encoding="ascii")
        if (match := re.search(r"VmHWM:\s*(\d+) kB", status)) is not None:
            return int(match[1]) / 2**10
    import resource

    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak / 2**20 if sys.platform == "darwin" else peak / 2**10


def _plain(value: Any) -> Any:
    """The same value in types that JSON knows."""
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, np.ndarray | list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
