"""One damped Gauss-Newton iteration of the differential solve: batched executor against GTSAM and scipy.

    python -m experiments.benchmarks.iteration [--frames 159 --points 300 --repeats 5 --out DIR]

All solve the same linear systems of the same pair factors on a spanning tree of a bending sheet:

- `batched`: the executor's whole step (linearise, eliminate, solve, evaluate);
- `gtsam`: linearise and eliminate one graph of all pair factors, driven from Python;
- `scipy`: `least_squares(method="trf")` point by point with the analytic Jacobian, limited to one iteration; it is
  timed on a sample of the points and scaled up.

The figure to quote is the ratio of medians. Steps are compared, so that all solve the same problem.
"""

from __future__ import annotations

import argparse
import csv
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path

import gtsam
import numba
import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import csr_array

from connrsfm_graph.problem import Problem, State, make_problem, planar_state
from connrsfm_graph.solvers.batched import BatchedBackend
from connrsfm_graph.solvers.gtsam_backend import damped, full_graph, point_graph
from connrsfm_graph.synthetic import isometric_bending
from factors import keys
from factors.noise import PairNoise

ACTIVE = {"joint": ("d", "c", "s"), "step 1": ("c",), "step 2": ("d",)}
NOISE = PairNoise(1.0, 10.0, 30.0)
DAMPING = 1e-3
SCIPY_POINTS = 3


def bending_problem(frames: int, points: int) -> tuple[Problem, State]:
    """A bending sheet with exact warps on a chain of images, started a little off the truth."""
    scene = isometric_bending(n_frames=frames, n_points=points, smooth=True)
    edges = np.stack([np.arange(frames - 1), np.arange(1, frames)], axis=-1)
    weight = np.ones((frames - 1, points))
    problem = make_problem(scene.image, scene.tracks.visible, edges, scene.jets(edges), weight)
    first_order = scene.first_order.transpose(1, 0, 2)
    off = np.random.default_rng(0).normal(scale=0.05, size=first_order.shape)
    return problem, planar_state(problem, first_order + off)


def timed(work: Callable[[], object], repeats: int) -> float:
    """Median seconds of a call."""
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return statistics.median(seconds)


def gtsam_step(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, ordering: gtsam.Ordering) -> gtsam.VectorValues:
    """Linearise and eliminate."""
    return damped(graph.linearize(values), values, DAMPING).optimize(ordering)


def scipy_iteration(problem: Problem, state: State, point: int, active: tuple[str, ...]) -> None:
    """One iteration of scipy's trust-region reflective solver on one point."""
    graph, values = point_graph(problem, state, point, active, NOISE)
    ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(graph)
    delta = values.zeroVectors()
    columns = [ordering.at(k) for k in range(ordering.size())]
    sizes = [delta.at(key).size for key in columns]

    def moved(x: np.ndarray) -> gtsam.Values:
        step = gtsam.VectorValues()
        for key, part in zip(columns, np.split(x, np.cumsum(sizes)[:-1]), strict=True):
            step.insert(key, part)
        return values.retract(step)

    def residual(x: np.ndarray) -> np.ndarray:
        return -graph.linearize(moved(x)).jacobian(ordering)[1]

    def jacobian(x: np.ndarray) -> csr_array:
        return csr_array(graph.linearize(moved(x)).jacobian(ordering)[0])

    least_squares(residual, np.zeros(sum(sizes)), jacobian, method="trf", max_nfev=2)


def largest_difference(step: gtsam.VectorValues, values: gtsam.Values, before: State, after: State) -> float:
    """Between GTSAM's step and the executor's."""
    columns = {"d": slice(0, 2), "c": slice(2, 5), "b": slice(5, 6)}
    worst = 0.0
    moved, scaled = after.frame - before.frame, after.log_scale - before.log_scale
    for key in values.keys():
        letter, point, second = keys.decode(key)
        ours = scaled[point, [second]] if letter == "s" else moved[point, second, columns[letter]]
        worst = max(worst, float(np.abs(ours - step.at(key)).max()))
    return worst


def main(arguments: list[str] | None = None) -> list[dict[str, object]]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=159)
    parser.add_argument("--points", type=int, default=300)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, help="folder for iteration.csv")
    options = parser.parse_args(arguments)
    problem, state = bending_problem(options.frames, options.points)
    pairs = int((problem.weight > 0).sum())
    backend = BatchedBackend()
    print(f"{platform.machine()}, {numba.get_num_threads()} threads, Python {platform.python_version()}")
    print(f"{options.frames} images x {options.points} points, {pairs} point-edge pairs")
    rows: list[dict[str, object]] = []
    for name, active in ACTIVE.items():
        after = backend.step(problem, state, active, NOISE, damping=DAMPING)
        graph, values = full_graph(problem, state, active, NOISE)
        ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(graph)
        step = gtsam_step(graph, values, ordering)
        seconds = {
            "batched": timed(lambda a=active: backend.step(problem, state, a, NOISE, damping=DAMPING), options.repeats),
            "gtsam": timed(lambda g=graph, v=values, o=ordering: gtsam_step(g, v, o), max(options.repeats // 2, 1)),
        }
        sample = range(min(SCIPY_POINTS, options.points))
        each = [timed(lambda i=i, a=active: scipy_iteration(problem, state, i, a), 1) for i in sample]
        seconds["scipy"] = statistics.median(each) * options.points
        rows += [
            {
                "iteration": name,
                "solver": solver,
                "seconds": round(value, 5),
                "microseconds per pair": round(1e6 * value / pairs, 2),
                "times batched": round(value / seconds["batched"], 1),
            }
            for solver, value in seconds.items()
        ]
        print(f"{name}: largest difference of the steps {largest_difference(step, values, state, after):.1e}")
        for row in rows[-len(seconds) :]:
            print(
                "  {solver:8s} {seconds:10.4f} s  {microseconds per pair:9.2f} us/pair  {times batched:8.1f} x".format(
                    **row
                )
            )
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        with (options.out / "iteration.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            writer.writerows(rows)
    return rows


if __name__ == "__main__":
    main()
