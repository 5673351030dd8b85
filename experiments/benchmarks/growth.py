"""Incremental fusion of a long sequence: time per view, and how far its estimate is above the minimum of the batch.

A simulated reconstruction of a waving sheet, all points in view, with odometry (see `experiments.slam`).

    python -m experiments.benchmarks.growth

prints the figures and writes growth.md and growth.csv with the milliseconds of every view, by the clock.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from connrsfm_graph.slam import IncrementalFusion, SlamConfig, trajectory_error
from experiments.slam import Case, simulated_case

AROUND = 10
"""Time per view is the median over this many views before and after."""


def grow(case: Case) -> tuple[IncrementalFusion, np.ndarray]:
    """The estimate after all views of a case, and the milliseconds (F,) of every view."""
    fusion = IncrementalFusion(case.noise, first=case.scene.poses[0])
    sigmas, milliseconds = SlamConfig().odometry_sigmas(case.steps), []
    for view in range(case.sightings.n_views):
        started = time.perf_counter()
        step = (case.steps[view - 1], sigmas[view - 1]) if view else (None, None)
        fusion.add_view(case.sightings.view(view), *step)
        milliseconds.append(1e3 * (time.perf_counter() - started))
    return fusion, np.array(milliseconds)


def report(case: Case, fusion: IncrementalFusion, milliseconds: np.ndarray) -> str:
    """The figures as text."""
    F = fusion.n_views
    early, late = (np.median(milliseconds[at - AROUND : at + AROUND]) for at in (min(50, F // 2), F - AROUND))
    online = fusion.cost()
    poses = np.array([fusion.pose(view) for view in range(F)])
    started = time.perf_counter()
    fusion.relax()
    relaxation = time.perf_counter() - started
    started = time.perf_counter()
    fused = fusion.finish()
    finish = time.perf_counter() - started
    return "\n".join(
        [
            f"time per view     {early:.0f} ms at view {min(50, F // 2)}, {late:.0f} ms at view {F}: "
            f"{late / early:.2f} times; {milliseconds.sum() / 1e3:.1f} s in all, longest {milliseconds.max():.0f} ms",
            f"one relaxation    {relaxation:.2f} s of all {F} cameras",
            f"cost              {online:.1f} view by view, {fused.cost:.1f} in batch: "
            f"{100 * (online / fused.cost - 1):.3f} % above",
            f"ATE               {trajectory_error(poses, case.scene.poses).ate:.5f} view by view, "
            f"{trajectory_error(fused.poses, case.scene.poses).ate:.5f} in batch",
            f"finish            {finish:.1f} s in {len(fused.cost_history) - 1} steps",
        ]
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/benchmarks"), help="folder (default: %(default)s)")
    parser.add_argument("--frames", type=int, default=500)
    parser.add_argument("--points", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    grow(simulated_case(40, 20, 0, options.seed))  # compiles
    case = simulated_case(options.frames, options.points, 0, options.seed)
    fusion, milliseconds = grow(case)
    options.out.mkdir(parents=True, exist_ok=True)
    np.savetxt(options.out / "growth.csv", milliseconds, fmt="%.3f", header="milliseconds of each view")
    text = report(case, fusion, milliseconds)
    print(text)
    heading = f"# Fusion view by view, {options.frames} views x {options.points} points"
    (options.out / "growth.md").write_text(f"{heading}\n\n```\n{text}\n```\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
