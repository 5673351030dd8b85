"""Tables and figures from one command: `python -m experiments all`, `quick`, or names.

Every experiment writes NAME.csv, NAME.md and NAME.png into the results folder and goes on where it was interrupted.
`publish` after them puts the tables into the pages that show them.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from experiments import accuracy, cloth, dense, slam, theorem, truth
from experiments.ablations import ABLATION, EDGES, ITERATIONS, ROW_SIGMAS, STARTING_VALUES
from experiments.missing import MISSING
from experiments.publish import publish
from experiments.real import FLAG, KINECT_PAPER, TSHIRT
from experiments.study import Experiment, Options
from experiments.summary import summarise
from experiments.synthetic import AT_REST, MIXED, ORTHOGRAPHIC_SCENES, SPHERES, VARIETY
from experiments.timing import PARALLEL, TIME

TABLES: tuple[Experiment, ...] = (
    SPHERES,
    TSHIRT,
    KINECT_PAPER,
    ABLATION,
    ITERATIONS,
    STARTING_VALUES,
    EDGES,
    ROW_SIGMAS,
    TIME,
    PARALLEL,
    MISSING,
    FLAG,
    MIXED,
    ORTHOGRAPHIC_SCENES,
    AT_REST,
    VARIETY,
)
DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def verify_theorem(options: Options) -> None:
    """The paper's numerical verification, see `experiments.theorem`."""
    size = ["--pairs", "3"] if options.quick else []
    theorem.main(["--out", str(options.out), *size])


def fuse_with_poses(options: Options) -> None:
    """Deformable fusion against its parts, see `experiments.slam`."""
    size = ["--frames", "60", "--points", "60", "--real-frames", "0"] if options.quick else []
    slam.main(["--out", str(options.out), *size])


EXPERIMENTS: dict[str, Callable[[Options], None]] = {
    "theorem": verify_theorem,
    **{experiment.name: experiment for experiment in TABLES},
    "cloth": cloth.measure,
    "truth": truth.measure,
    "dense": dense.measure,
    "accuracy": accuracy.measure,
    "slam": fuse_with_poses,
    "summary": summarise,
}
"""By name, in the order in which `all` runs them; one more entry adds one."""
APART = ("accuracy",)
"""Run by name and in a quick run only: it measures much of the same data again, for half an hour."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m experiments", description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "names",
        nargs="+",
        choices=["all", "quick", *EXPERIMENTS, "publish"],
        metavar="NAME",
        help=", ".join(EXPERIMENTS)
        + f"; all of them but {', '.join(APART)}, or a quick part of all; publish writes the tables measured so "
        "far into the pages that show them",
    )
    parser.add_argument("--data", type=Path, default=DATA, help="folder of the real data sets (default: %(default)s)")
    parser.add_argument("--out", type=Path, default=Path("results"), help="folder for results (default: %(default)s)")
    given = parser.parse_args(arguments)
    options = Options(given.data, given.out, quick="quick" in given.names)
    if options.quick:
        options = replace(options, out=given.out / "quick")
    names = [name for name in given.names if name != "publish"]
    if {"all", "quick"} & set(names):
        names = [name for name in EXPERIMENTS if options.quick or name not in APART]
    options.out.mkdir(parents=True, exist_ok=True)
    start = time.perf_counter()
    for name in names:
        EXPERIMENTS[name](options)
    if "publish" in given.names and not options.quick:
        publish(options.out, list(EXPERIMENTS))
    print(f"{len(names)} experiments in {(time.perf_counter() - start) / 60:.1f} minutes, results in {options.out}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
