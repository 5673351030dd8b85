"""Data set by method, from the results of the other experiments: the table of the project's README."""

from __future__ import annotations

from collections.abc import Mapping

from experiments.real import FLAG, KINECT_PAPER, TSHIRT
from experiments.study import VARIANTS, Experiment, Group, Options, group, read_rows, with_spread
from experiments.synthetic import MIXED, SPHERES

DIGITS = 2
PUBLISHED = "Con-NRSfM as published"
SOURCES: tuple[Experiment, ...] = (SPHERES, MIXED, TSHIRT, FLAG, KINECT_PAPER)


def summarise(options: Options) -> None:
    """Write summary.md from what was measured so far; data sets without results are left out."""
    lines = ["### 3D error in percent, mean over seeds", ""]
    lines += [_line(["", *VARIANTS, PUBLISHED]), _line(["---"] * (2 + len(VARIANTS)))]
    remarks = []
    for experiment in SOURCES:
        rows = read_rows(options.out / f"{experiment.name}.csv")
        columns = [name for name in ("condition", "method") if rows and name in rows[0]]
        conditions: dict[str, dict[str, Group]] = {}
        for each in group(rows, columns):
            conditions.setdefault(each.keys.get("condition", ""), {})[each.keys["method"]] = each
        for condition, methods in conditions.items():
            name = f"{experiment.title.split(':')[0]}{', ' * bool(condition)}{condition}"
            published = experiment.published.get((*[condition] * bool(condition), "paper mode"), "").partition(" ")[0]
            lines.append(_line([name, *_cells(methods), published]))
            best = _best(methods)
            if "default" not in methods:
                remarks.append(f"{name}: our default mode was not run.")
            elif "default" not in best:
                remarks.append(f"{name}: {' and '.join(best)} ahead of our default mode.")
    text = "\n".join([*lines, "", *(remarks or ["Our default mode is ahead on every line."])]) + "\n"
    (options.out / "summary.md").write_text(text, encoding="utf-8")
    print(text)


def _best(methods: Mapping[str, Group]) -> list[str]:
    """Those with the least error as the table shows it: what comes after two digits decides nothing."""
    errors = {name: round(each.mean["e3d_percent"], DIGITS) for name, each in methods.items() if each.runs}
    return [name for name, error in errors.items() if error == min(errors.values())]


def _cells(methods: Mapping[str, Group]) -> list[str]:
    """One cell per method, the best in bold, a dash where it was not run."""
    cells = {name: with_spread(each, "e3d_percent", DIGITS) if each.runs else "fails" for name, each in methods.items()}
    best = _best(methods)
    return [f"**{cells[name]}**" if name in best else cells.get(name, "-") for name in VARIANTS]


def _line(cells: list[str]) -> str:
    return f"| {' | '.join(cells)} |"
