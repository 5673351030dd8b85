"""Benchmarks from one command: `python -m experiments.benchmarks`, or with names.

    iteration   one iteration of the differential solve by different solvers
    pipeline    tracks to points, stage by stage, against size
    parallel    one thread, all threads, all processes

Each writes NAME.csv and NAME.md, row by row; a row that is there is not measured again. Figures are to be compared
within one run on a machine that does nothing else. All of them take about 20 minutes on two cores.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from experiments.benchmarks.iteration import measure_iteration
from experiments.benchmarks.pipeline import SIZES, measure_parallel, measure_pipeline

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
    parser.add_argument("names", nargs="*", choices=[*BENCHMARKS, []], metavar="NAME", help=", ".join(BENCHMARKS))
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="folder (default: %(default)s)")
    parser.add_argument(
        "--sizes", type=_size, nargs="+", metavar="FxP", default=SIZES, help="images x points of the pipeline"
    )
    given = parser.parse_args(arguments)
    started = time.perf_counter()
    for name in given.names or BENCHMARKS:
        if name == "pipeline":
            measure_pipeline(given.out, given.sizes)
        else:
            BENCHMARKS[name](given.out)
    print(f"{(time.perf_counter() - started) / 60:.1f} minutes, tables in {given.out}")
    return 0


def _size(text: str) -> tuple[int, int]:
    frames, _, points = text.partition("x")
    return int(frames), int(points)


if __name__ == "__main__":
    raise SystemExit(main())
