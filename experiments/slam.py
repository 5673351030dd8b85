"""Deformable fusion against its parts: a camera passes a waving sheet before a rigid background.

Two reconstructions without poses are fused with odometry of 2 % and 1 degree per step: a simulated one (noisy, bent, in
a drifting unit) and the real one, `reconstruct` from noisy tracks of a shorter sequence. Compared in one world frame:

    odometry                  its steps chained
    views chained one by one  the reconstruction alone, every view fitted to those before; the whole then aligned to the
                              truth by a similarity, since it has no unit
    views aligned one by one  every view fitted to the truth by a similarity of its own: no poses could be better
    rigid                     the same fusion in the belief that the surface does not move
    fused, odometry only      no background: minimum deformation decides
    fused                     odometry and background
    incremental               view by view, no background; each view is written down when the last has come
    live                      (real) the first 40 views reconstructed together, the others from tracks, one by one

ATE and RPE are those of the camera in the world's unit (the sheet is 2 wide, the path about 4 long), after alignment by
rotation and translation; the surface error is the root mean square distance of map points to the truth, in the frame of
the first camera; seconds are those of the processor, without the reconstruction, and per view where views come one by
one.

    python -m experiments.slam --out DIR

prints both tables and writes slam.csv, slam_real.csv and slam.md.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from connrsfm_graph.files import written_beside
from connrsfm_graph.metrics.alignment import align_similarity
from connrsfm_graph.reconstruct import reconstruct
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.slam import (
    Fused,
    FusionNoise,
    IncrementalConfig,
    IncrementalFusion,
    Sightings,
    SlamConfig,
    estimate_noise,
    fuse_live,
    pose_problem,
    solve_problem,
    trajectory_error,
)
from connrsfm_graph.slam.cameras import start_cameras
from connrsfm_graph.slam.minimise import camera_arrays
from connrsfm_graph.slam.trajectory import chained
from connrsfm_graph.synthetic.passing_camera import PassingScene, noisy_odometry, passing_camera, relative_depth
from connrsfm_graph.synthetic.scene import INTRINSICS
from connrsfm_graph.tracks import Tracks
from experiments.study import save

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
    image: np.ndarray
    """(F, P, 2) noisy image points, normalised coordinates."""
    sightings: Sightings
    noise: FusionNoise
    steps: np.ndarray
    background: tuple[np.ndarray, np.ndarray]


def simulated_case(frames: int, points: int, background: int, seed: int) -> Case:
    """A simulated reconstruction; the noise levels are estimated from it."""
    scene = passing_camera(frames, points, background, seed=seed)
    rng = np.random.default_rng(seed + 1)
    image = scene.image + IMAGE_SIGMA * rng.normal(size=scene.image.shape)
    sightings = Sightings.checked(image, relative_depth(scene, seed=seed + 2), scene.visible)
    return _case(scene, image, sightings, estimate_noise(sightings, IMAGE_SIGMA), rng, seed)


def real_case(frames: int, points: int, background: int, seed: int) -> Case:
    """A reconstruction from noisy tracks; the noise levels are estimated from it."""
    scene = passing_camera(frames, points, background, seed=seed)
    rng = np.random.default_rng(seed + 1)
    image = scene.image + IMAGE_SIGMA * rng.normal(size=scene.image.shape)
    made = reconstructed(scene, image, frames)
    return _case(scene, image, Sightings.of(made), estimate_noise(made), rng, seed)


def reconstructed(scene: PassingScene, image: np.ndarray, frames: int) -> Reconstruction:
    """The first frames, reconstructed without poses."""
    pixels = image[:frames] * INTRINSICS[0, 0] + INTRINSICS[:2, 2]
    return reconstruct(Tracks.checked(pixels, INTRINSICS, scene.visible[:frames]))[0]


def _case(
    scene: PassingScene,
    image: np.ndarray,
    sightings: Sightings,
    noise: FusionNoise,
    rng: np.random.Generator,
    seed: int,
) -> Case:
    steps, _ = noisy_odometry(scene.poses, seed=seed + 3)
    seen = scene.background_image + IMAGE_SIGMA * rng.normal(size=scene.background_image.shape)
    return Case(scene, image, sightings, noise, steps, (seen, scene.background_visible))


def compare(case: Case, lag: int) -> list[Row]:
    """All lines of the table that both reconstructions have."""
    rows = [
        trajectory_row("odometry", case, chained(case.steps, case.scene.poses[0])),
        chained_one_by_one(case),
        Row("views aligned one by one", surface=aligned_one_by_one(case)),
    ]
    still = replace(case.noise, motion=RIGID_MOTION * case.noise.motion)
    for method, noise, background in (
        ("rigid", still, case.background),
        ("fused, odometry only", case.noise, None),
        ("fused", case.noise, case.background),
    ):
        started = time.process_time()
        problem = pose_problem(case.sightings, None, noise, case.steps, background, case.scene.poses[0])
        fused = solve_problem(problem)
        rows.append(fused_row(method, case, fused, time.process_time() - started))
    return [*rows, incremental(case, lag)]


def incremental(case: Case, lag: int) -> Row:
    """The views one by one; the scale of the first view is unknown to a factor of e."""
    fusion = IncrementalFusion(case.noise, IncrementalConfig(lag=lag), case.scene.poses[0])
    sigmas, started = SlamConfig().odometry_sigmas(case.steps), time.process_time()
    for view in range(case.sightings.n_views):
        step = (case.steps[view - 1], sigmas[view - 1]) if view else (None, None)
        fusion.add_view(case.sightings.view(view), *step)
    return incremental_row("incremental", case, fusion, (time.process_time() - started) / fusion.n_views)


def live(case: Case, together: int) -> Row:
    """The first views reconstructed together, the others from their tracks; time per view of these."""
    first = Sightings.of(reconstructed(case.scene, case.image, together))
    started = time.process_time()
    found = fuse_live(first, case.image, case.scene.visible, steps=case.steps, pose=case.scene.poses[0])
    seconds = (time.process_time() - started) / (len(case.image) - together)
    return incremental_row("live", case, found.fusion, seconds)


def chained_one_by_one(case: Case) -> Row:
    """Without odometry: every view fitted to the mean of where those before put its points."""
    R, t, g = camera_arrays(start_cameras(case.sightings, case.noise), range(case.sightings.n_views))
    points = np.exp(g)[:, None, None] * case.sightings.points()
    points = np.einsum("fij,fpj->fpi", R, points) + t[:, None]
    seen = case.sightings.seen
    scale, turn, shift = align_similarity(points[seen], case.scene.points[seen])
    poses = np.tile(np.eye(4), (len(R), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = turn @ R, scale * t @ turn.T + shift
    surface = root_mean_square(scale * points[seen] @ turn.T + shift - case.scene.points[seen])
    return replace(trajectory_row("views chained one by one", case, poses), surface=surface)


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


def incremental_row(method: str, case: Case, fusion: IncrementalFusion, seconds: float) -> Row:
    views = range(fusion.n_views)
    error = [fusion.map_points(view) - case.scene.points[view, fusion.map.views[view].points] for view in views]
    row = trajectory_row(method, case, np.array([fusion.pose(view) for view in views]))
    return replace(row, surface=root_mean_square(np.concatenate(error)), seconds=seconds)


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
    parser.add_argument("--out", type=Path, required=True, help="folder for the tables")
    parser.add_argument("--frames", type=int, default=200, help="of the simulated reconstruction")
    parser.add_argument("--points", type=int, default=150)
    parser.add_argument("--real-frames", type=int, default=60, help="of the real reconstruction; 0 leaves it out")
    parser.add_argument("--real-points", type=int, default=100)
    parser.add_argument("--together", type=int, default=40, help="views that live fusion starts from")
    parser.add_argument("--background", type=int, default=60, help="points of the background")
    parser.add_argument("--lag", type=int, default=30, help="views the incremental fusion estimates together")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    options.out.mkdir(parents=True, exist_ok=True)
    case = simulated_case(options.frames, options.points, options.background, options.seed)
    rows = compare(case, options.lag)
    save(options.out / "slam.csv", rows)
    text = f"simulated reconstruction, {options.frames} views x {options.points} points\n{table(rows)}"
    print(text)
    if options.real_frames:
        case = real_case(options.real_frames, options.real_points, options.background, options.seed)
        rows = [*compare(case, options.lag), live(case, options.together)]
        save(options.out / "slam_real.csv", rows)
        real = f"real reconstruction, {options.real_frames} views x {options.real_points} points\n{table(rows)}"
        print(f"\n{real}")
        text += f"\n\n{real}"
    with written_beside(options.out / "slam.md") as part:
        part.write_text(f"# Deformable fusion with camera poses\n\n```\n{text}\n```\n", encoding="utf-8")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
