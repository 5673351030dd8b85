"""Deformable fusion against its parts: a camera passes a waving sheet before a rigid background.

A simulated reconstruction (noisy, bent, in a drifting unit) and odometry of 2 % and 1 degree per step are fused, and
compared in one world frame with

    odometry                  its steps chained
    views aligned one by one  the reconstruction without poses, every view fitted to the truth: no pose could be better
    rigid                     the same fusion in the belief that the surface does not move
    fused, odometry only      no background: minimum deformation decides
    fused                     odometry and background
    incremental               the views one by one with a fixed lag, no background

ATE and RPE are those of the camera in the world's unit (the sheet is 2 wide, the path about 4 long), after alignment by
rotation and translation; the surface error is the root mean square distance of map points to the truth, in the frame of
the first camera.

    python -m experiments.slam --out DIR

prints the table and writes slam.csv, and growth.csv with the milliseconds of every view of the incremental fusion.
"""

from __future__ import annotations

import argparse
import csv
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from connrsfm_graph.metrics.alignment import align_similarity
from connrsfm_graph.slam import (
    Fused,
    FusionNoise,
    IncrementalConfig,
    IncrementalFusion,
    Sightings,
    SlamConfig,
    estimate_noise,
    pose_problem,
    solve_problem,
    trajectory_error,
)
from connrsfm_graph.slam.trajectory import chained
from connrsfm_graph.synthetic.passing_camera import PassingScene, noisy_odometry, passing_camera, relative_depth

IMAGE_SIGMA = 1e-3
"""Half a pixel of the virtual camera."""
RIGID_MOTION = 1e-3
"""The rigid belief: motion as a part of what is estimated from the views."""


@dataclass(frozen=True)
class Row:
    """One line of the table; NaN where a method says nothing."""

    method: str
    ate: float = np.nan
    rpe_translation: float = np.nan
    rpe_rotation_deg: float = np.nan
    surface: float = np.nan
    seconds: float = np.nan


@dataclass(frozen=True)
class Case:
    """What the methods are given, and the truth."""

    scene: PassingScene
    sightings: Sightings
    noise: FusionNoise
    steps: np.ndarray
    background: tuple[np.ndarray, np.ndarray]


def make_case(frames: int, points: int, background: int, seed: int) -> Case:
    """Simulate; the noise levels are estimated from the simulated measurements."""
    scene = passing_camera(frames, points, background, seed=seed)
    rng = np.random.default_rng(seed + 1)
    image = scene.image + IMAGE_SIGMA * rng.normal(size=scene.image.shape)
    sightings = Sightings.checked(image, relative_depth(scene, seed=seed + 2), scene.visible)
    steps, _ = noisy_odometry(scene.poses, seed=seed + 3)
    seen = scene.background_image + IMAGE_SIGMA * rng.normal(size=scene.background_image.shape)
    noise = estimate_noise(sightings, IMAGE_SIGMA)
    return Case(scene, sightings, noise, steps, (seen, scene.background_visible))


def compare(case: Case, lag: int) -> tuple[list[Row], np.ndarray]:
    """All lines of the table, and the milliseconds (F,) of every view of the incremental fusion."""
    rows = [
        trajectory_row("odometry", case, chained(case.steps, case.scene.poses[0])),
        Row("views aligned one by one", surface=aligned_one_by_one(case)),
    ]
    still = replace(case.noise, motion=RIGID_MOTION * case.noise.motion)
    for method, noise, background in (
        ("rigid", still, case.background),
        ("fused, odometry only", case.noise, None),
        ("fused", case.noise, case.background),
    ):
        started = time.perf_counter()
        problem = pose_problem(case.sightings, None, noise, case.steps, background, case.scene.poses[0])
        fused = solve_problem(problem)
        rows.append(fused_row(method, case, fused, time.perf_counter() - started))
    row, milliseconds = incremental(case, lag)
    return [*rows, row], milliseconds


def incremental(case: Case, lag: int) -> tuple[Row, np.ndarray]:
    """The views one by one; the scale of the first view is unknown to a factor of e."""
    fusion = IncrementalFusion(case.noise, IncrementalConfig(lag=lag), case.scene.poses[0])
    sigmas, milliseconds = SlamConfig().odometry_sigmas(case.steps), []
    for view in range(case.sightings.n_views):
        started = time.process_time()
        step = (case.steps[view - 1], sigmas[view - 1]) if view else (None, None)
        fusion.add_view(case.sightings.view(view), *step)
        milliseconds.append(1e3 * (time.process_time() - started))
    poses = np.array([fusion.pose(view) for view in range(fusion.n_views)])
    error = [
        fusion.map_points(view) - case.scene.points[view, case.sightings.view(view).points]
        for view in range(fusion.n_views)
    ]
    row = trajectory_row("incremental", case, poses)
    seconds = sum(milliseconds) / 1e3
    return replace(row, surface=root_mean_square(np.concatenate(error)), seconds=seconds), np.array(milliseconds)


def aligned_one_by_one(case: Case) -> float:
    """Surface error where every view is fitted to the truth by a similarity of its own."""
    error = []
    for seen, camera_points, truth in zip(case.sightings.seen, case.sightings.points(), case.scene.points, strict=True):
        scale, R, t = align_similarity(camera_points[seen], truth[seen])
        error.append(scale * camera_points[seen] @ R.T + t - truth[seen])
    return root_mean_square(np.concatenate(error))


def trajectory_row(method: str, case: Case, poses: np.ndarray) -> Row:
    error = trajectory_error(poses, case.scene.poses)
    return Row(method, error.ate, error.rpe_translation, error.rpe_rotation_deg)


def fused_row(method: str, case: Case, fused: Fused, seconds: float) -> Row:
    error = (fused.points - case.scene.points)[case.sightings.seen]
    return replace(trajectory_row(method, case, fused.poses), surface=root_mean_square(error), seconds=seconds)


def root_mean_square(vectors: np.ndarray) -> float:
    """Of the lengths of vectors (N, 3)."""
    return float(np.sqrt((vectors**2).sum(axis=1).mean()))


def table(rows: Sequence[Row]) -> str:
    """The comparison as text."""
    lines = [f"{'method':<26}{'ATE':>10}{'RPE':>10}{'RPE deg':>10}{'surface':>10}{'seconds':>10}"]
    for row in rows:
        figures = (row.ate, row.rpe_translation, row.rpe_rotation_deg, row.surface, row.seconds)
        lines.append(f"{row.method:<26}" + "".join(f"{'-' if np.isnan(x) else f'{x:.4g}':>10}" for x in figures))
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder for slam.csv and growth.csv")
    parser.add_argument("--frames", type=int, default=200)
    parser.add_argument("--points", type=int, default=150)
    parser.add_argument("--background", type=int, default=60, help="points of the background")
    parser.add_argument("--lag", type=int, default=30, help="views the incremental fusion estimates together")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    case = make_case(options.frames, options.points, options.background, options.seed)
    rows, milliseconds = compare(case, options.lag)
    options.out.mkdir(parents=True, exist_ok=True)
    with (options.out / "slam.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["method", "ate", "rpe_translation", "rpe_rotation_deg", "surface", "seconds"])
        writer.writerows(
            [row.method, row.ate, row.rpe_translation, row.rpe_rotation_deg, row.surface, row.seconds] for row in rows
        )
    np.savetxt(options.out / "growth.csv", milliseconds, fmt="%.3f", header="milliseconds of each view")
    print(table(rows))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
