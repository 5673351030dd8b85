"""One damped Gauss-Newton iteration of the differential solve: batched executor against GTSAM, scipy and torch.

    python -m experiments.benchmarks.iteration [--frames 159 --points 300 --repeats 5 --out DIR]

All solve the same linear systems of the same pair factors on a spanning tree of a bending sheet:

- `batched`: the executor's whole step (linearise, eliminate, solve, evaluate);
- `GTSAM`: linearise and eliminate one graph of all pair factors, driven from Python;
- GTSAM's own Levenberg-Marquardt, one iteration point by point;
- scipy's `least_squares(method="trf")` point by point with the analytic Jacobian, limited to one iteration;
- `torch`: the step vectorised over all points (see `torch_step`), on the GPU too where there is one.

What goes point by point is timed on a sample of the points and scaled up.

The figure to quote is the ratio of medians. Steps are compared, so that all solve the same problem.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import gtsam
import numpy as np
from scipy.optimize import least_squares
from scipy.sparse import csr_array

from connrsfm_graph.problem import Problem, State, make_problem, planar_state
from connrsfm_graph.solvers.batched import BatchedBackend
from connrsfm_graph.solvers.gtsam_backend import damped, full_graph, point_graph
from connrsfm_graph.synthetic import isometric_bending
from experiments.benchmarks.table import Row, Table, cores
from factors import keys
from factors.conformal_pair import SLOTS
from factors.noise import PairNoise

ACTIVE = {"joint": ("d", "c", "s"), "step 1": ("c",), "step 2": ("d",)}
NOISE = PairNoise(1.0, 10.0, 30.0)
DAMPING = 1e-3
SAMPLE = 3
"""Points of which those that go point by point are timed."""
TORCH_REPEATS = 2
SAME_STEP = 1e-6


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


def scipy_iteration(problem: Problem, state: State, point: int, active: tuple[str, ...]) -> Callable[[], object]:
    """One iteration of scipy's trust-region reflective solver on one point, to be timed."""
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

    return partial(least_squares, residual, np.zeros(sum(sizes)), jacobian, method="trf", max_nfev=2)


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


def built_in_iteration(problem: Problem, state: State, point: int, active: tuple[str, ...]) -> Callable[[], object]:
    """One iteration of GTSAM's own Levenberg-Marquardt on one point, to be timed."""
    graph, values = point_graph(problem, state, point, active, NOISE)
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setlambdaInitial(DAMPING)
    return gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).iterate


def torch_steps(problem: Problem, state: State, active: tuple[str, ...], expected: State) -> dict[str, float]:
    """Seconds of the vectorised torch version, by device; nothing where torch is absent.

    Raises:
        RuntimeError: its step is another one.
    """
    try:
        import torch
    except ImportError:
        return {}
    from experiments.benchmarks.torch_step import make_step

    columns = [column for letter in "dc" if letter in active for column in range(*SLOTS[letter][0])]
    seconds = {}
    for name, device in (("torch", "cpu"), ("torch, GPU", "cuda")):
        if device == "cuda" and not torch.cuda.is_available():
            continue
        torch.set_num_threads(cores())
        step = make_step(problem, state, active, NOISE, DAMPING, device)
        gap = np.abs(step().numpy() - (expected.frame - state.frame)[..., columns]).max()
        if not gap < SAME_STEP:
            raise RuntimeError(f"the step of {name} differs by {gap:.1e}")
        seconds[name] = timed(step, TORCH_REPEATS)
    return seconds


def measure_iteration(out: Path, frames: int = 159, points: int = 300, repeats: int = 5) -> None:
    """`iteration.csv` and `.md`."""
    table = Table(out, "iteration", ("iteration", "solver"))
    if all(any(row["iteration"] == name for row in table.rows) for name in ACTIVE):
        return
    problem, state = bending_problem(frames, points)
    pairs = int((problem.weight > 0).sum())
    backend = BatchedBackend()
    for name, active in ACTIVE.items():
        after = backend.step(problem, state, active, NOISE, damping=DAMPING)
        graph, values = full_graph(problem, state, active, NOISE)
        ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(graph)
        gap = largest_difference(gtsam_step(graph, values, ordering), values, state, after)
        if not gap < SAME_STEP:
            raise RuntimeError(f"the steps of GTSAM and of the executor differ by {gap:.1e}")

        def per_point(made: Callable[..., Callable[[], object]], active: tuple[str, ...]) -> float:
            sample = range(min(SAMPLE, points))
            return statistics.median(timed(made(problem, state, i, active), 1) for i in sample) * points

        seconds = {
            "batched": timed(partial(backend.step, problem, state, active, NOISE, damping=DAMPING), repeats),
            "GTSAM": timed(partial(gtsam_step, graph, values, ordering), max(repeats // 2, 1)),
            "GTSAM's optimiser per point": per_point(built_in_iteration, active),
            "scipy TRF per point": per_point(scipy_iteration, active),
            **torch_steps(problem, state, active, after),
        }
        for solver, value in seconds.items():
            keys: Row = {"iteration": name, "solver": solver}
            figures = {
                "images": frames,
                "points": points,
                "seconds": round(value, 5),
                "microseconds per pair": round(1e6 * value / pairs, 2),
                "times batched": round(value / seconds["batched"], 1),
            }
            table.measure(keys, partial(dict, figures))
        table.write(
            {
                "iteration": lambda row: str(row["iteration"]),
                "solver": lambda row: str(row["solver"]),
                "s": lambda row: f"{float(row['seconds']):.4g}",
                "µs per pair": lambda row: str(row["microseconds per pair"]),
                "times batched": lambda row: str(row["times batched"]),
            }
        )


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, default=159)
    parser.add_argument("--points", type=int, default=300)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="folder for iteration.csv")
    given = parser.parse_args(arguments)
    measure_iteration(given.out, given.frames, given.points, given.repeats)
    print((given.out / "iteration.md").read_text(encoding="utf-8"))


if __name__ == "__main__":
    main()
