"""Benchmarks from one command: `python -m experiments.benchmarks`, or with names.

    iteration   one iteration of the differential solve by different solvers
    pipeline    tracks to points, stage by stage, against size
    parallel    one thread, all threads, all processes

Each writes NAME.csv and NAME.md, row by row; a row that is there is not measured again. Figures are to be compared
within one run on a machine that does nothing else. All of them take about ten minutes on two cores, the first run of
an installation one more, for it compiles. `publish` after them puts what was measured into the pages that show it.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from experiments.benchmarks.iteration import measure_iteration
from experiments.benchmarks.pipeline import SIZES, measure_parallel, measure_pipeline
from experiments.benchmarks.publish import publish

BENCHMARKS: dict[str, Callable[[Path], None]] = {
    "iteration": measure_iteration,
    "pipeline": measure_pipeline,
    "parallel": measure_parallel,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments.benchmarks",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "names",
        nargs="*",
        choices=[*BENCHMARKS, "publish", []],
        metavar="NAME",
        help=", ".join([*BENCHMARKS, "publish"]),
    )
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="folder (default: %(default)s)")
    parser.add_argument(
        "--sizes", type=_size, nargs="+", metavar="FxP", default=SIZES, help="images x points of the pipeline"
    )
    given = parser.parse_args(arguments)
    started = time.perf_counter()
    for name in given.names or BENCHMARKS:
        if name == "pipeline":
            measure_pipeline(given.out, given.sizes)
        elif name == "publish":
            publish(given.out)
        else:
            BENCHMARKS[name](given.out)
    print(f"{(time.perf_counter() - started) / 60:.1f} minutes, tables in {given.out}")
    return 0


def _size(text: str) -> tuple[int, int]:
    frames, _, points = text.partition("x")
    return int(frames), int(points)


if __name__ == "__main__":
    raise SystemExit(main())
