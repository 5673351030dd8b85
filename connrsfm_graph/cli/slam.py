"""Camera trajectory and deforming map in one world frame, from tracks and, if there is any, odometry.

Writes trajectory.tum (camera to world), map.ply (points of all views, with the numbers of view and point), problem.npz
(what was fused, to load in Python), and graph.dot (its factor graph to look at, views in groups where there are many).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from connrsfm_graph.cli.settings import add_configuration, resolved

if TYPE_CHECKING:
    import numpy as np

    from connrsfm_graph.progress import Progress
    from connrsfm_graph.reconstruction import Reconstruction
    from connrsfm_graph.slam import Fused, FusionProblem, SlamConfig
    from connrsfm_graph.tracks import Tracks

TRAJECTORY_FILE, MAP_FILE, PROBLEM_FILE, GRAPH_FILE = "trajectory.tum", "map.ply", "problem.npz", "graph.dot"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("tracks", type=Path, metavar="TRACKS", help=".npz, .mat or .csv file of point tracks")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for trajectory and map")
    parser.add_argument("--result", type=Path, metavar="RESULT", help="a finished reconstruction of these tracks")
    parser.add_argument("--odometry", type=Path, metavar="TUM", help="poses by odometry, one line per view")
    parser.add_argument(
        "--odometry-translation",
        type=float,
        default=0.02,
        metavar="S",
        help="error of a step over its length (default: %(default)s)",
    )
    parser.add_argument(
        "--odometry-rotation",
        type=float,
        default=1.0,
        metavar="DEG",
        help="error of a step's rotation in degrees (default: %(default)s)",
    )
    parser.add_argument("--background", type=Path, metavar="TRACKS", help="tracks of points that do not move")
    parser.add_argument(
        "--motion",
        choices=("position", "velocity"),
        default="position",
        help="what of a map point changes little from view to view (default: %(default)s)",
    )
    parser.add_argument(
        "--live",
        type=int,
        metavar="N",
        help="reconstruct the first N views together and take in the others one by one; N views must show the surface "
        "from sides some tens of degrees apart (default: all together; more than 1000 are fused one by one)",
    )
    parser.add_argument("--intrinsics", metavar="K", help="camera of the tracks, instead of the file's own")
    add_configuration(parser)


def run(arguments: argparse.Namespace) -> None:
    import numpy as np

    from connrsfm_graph.errors import InputError
    from connrsfm_graph.files import check_output_folder, folder_written_beside
    from connrsfm_graph.progress import Progress
    from connrsfm_graph.slam import FusionConfig, MapModel, SlamConfig, read_tum, save_problem, write_map, write_tum
    from connrsfm_graph.slam.cameras import STANDSTILL
    from connrsfm_graph.slam.drawing import write_drawing
    from connrsfm_graph.slam.fuse import MOST_VIEWS
    from connrsfm_graph.slam.trajectory import steps_between
    from connrsfm_graph.tracks import load_tracks

    out = check_output_folder(arguments.out)
    config = SlamConfig(
        FusionConfig(MapModel(motion=arguments.motion)), arguments.odometry_translation, arguments.odometry_rotation
    )
    tracks = load_tracks(arguments.tracks, arguments.intrinsics)
    if not tracks.camera.kappa:
        raise InputError(
            f"{arguments.tracks}: seen by an orthographic camera, which has no place; expected perspective"
        )
    times, odometry = (None, None) if arguments.odometry is None else read_tum(arguments.odometry)
    if odometry is not None and len(odometry) != tracks.n_frames:
        raise InputError(f"{arguments.odometry}: holds {len(odometry)} poses, expected one per view, {tracks.n_frames}")
    steps, first = (None, None) if odometry is None else (steps_between(odometry), odometry[0])
    progress = Progress()
    fusion = _all_together if arguments.live is None and tracks.n_frames <= MOST_VIEWS else _one_by_one
    background = None
    if arguments.background is not None:
        rigid = load_tracks(arguments.background, arguments.intrinsics)
        if rigid.n_frames != tracks.n_frames:
            raise InputError(
                f"{arguments.background}: holds {rigid.n_frames} images, expected one per view, {tracks.n_frames}"
            )
        background = np.nan_to_num(rigid.normalised()), rigid.visible
    problem, fused = fusion(arguments, tracks, config, steps, first, background, progress)
    with folder_written_beside(out) as part:
        write_tum(part / TRAJECTORY_FILE, fused.poses, times)
        write_map(part / MAP_FILE, fused)
        save_problem(part / PROBLEM_FILE, problem)
        write_drawing(part / GRAPH_FILE, problem)
    moved = steps is not None and bool(np.linalg.norm(steps[:, :3, 3], axis=1).max(initial=0.0) > STANDSTILL)
    unit = "of odometry" if moved else "of the first view's reconstruction"
    print(f"{len(fused.poses)} poses and {np.isfinite(fused.points).all(axis=-1).sum()} map points, in the unit {unit}")
    print(f"{out}: {TRAJECTORY_FILE}, {MAP_FILE}, {PROBLEM_FILE}, {GRAPH_FILE}")


def _all_together(
    arguments: argparse.Namespace,
    tracks: Tracks,
    config: SlamConfig,
    steps: np.ndarray | None,
    first: np.ndarray | None,
    background: tuple[np.ndarray, np.ndarray] | None,
    progress: Progress,
) -> tuple[FusionProblem, Fused]:
    """All views are reconstructed, then fused."""
    from connrsfm_graph.slam import Sightings, estimate_noise, pose_problem, solve_problem

    reconstruction = _reconstruction(arguments, tracks, progress)
    with progress.stage("noise levels"):
        noise = estimate_noise(reconstruction)
        problem = pose_problem(Sightings.of(reconstruction), config, noise, steps, background, first)
    with progress.stage("fusion"):
        return problem, solve_problem(problem, config.fusion, progress.update)


def _one_by_one(
    arguments: argparse.Namespace,
    tracks: Tracks,
    config: SlamConfig,
    steps: np.ndarray | None,
    first: np.ndarray | None,
    background: tuple[np.ndarray, np.ndarray] | None,
    progress: Progress,
) -> tuple[FusionProblem, Fused]:
    """The first views are reconstructed together, all are taken in one by one and, unless too many, let go of in the
    end."""
    import numpy as np

    from connrsfm_graph.errors import InputError
    from connrsfm_graph.slam import FusionProblem, Sightings, fuse_live
    from connrsfm_graph.slam.fuse import MOST_VIEWS

    together = tracks.n_frames if arguments.live is None else arguments.live
    if not 3 <= together <= tracks.n_frames:
        raise InputError(f"--live is {together}, expected 3 to {tracks.n_frames}, the number of views")
    known = Sightings.of(_reconstruction(arguments, tracks.select(frames=range(together)), progress))
    image = np.nan_to_num(tracks.normalised())
    try:
        with progress.stage("views"):
            live = fuse_live(known, image, tracks.visible, config, steps, first, progress.update, background)
    except InputError as error:
        mend = "" if steps is not None else "; give odometry, or leave the view out"
        raise InputError(f"{arguments.tracks}: {error}{mend}") from error
    if live.held:
        views = f"views {', '.join(map(str, live.held))} show" if len(live.held) > 1 else f"view {live.held[0]} shows"
        print(f"{views} too little of the surface; odometry places the camera there")
    with progress.stage("fusion"):
        fused = live.fusion.finish() if tracks.n_frames <= MOST_VIEWS else live.fusion.estimate()
    sightings, model = live.fusion.map.sightings(), config.fusion.map
    return FusionProblem(sightings, live.fusion.noise, model, live.fusion.graph, live.fusion.values), fused


def _reconstruction(arguments: argparse.Namespace, tracks: Tracks, progress: Progress) -> Reconstruction:
    """The one given, or one made now."""
    from connrsfm_graph.errors import InputError
    from connrsfm_graph.methods import METHODS
    from connrsfm_graph.reconstruction import Reconstruction
    from connrsfm_graph.tracks import check_reconstructable

    if arguments.result is not None:
        loaded = Reconstruction.load(arguments.result)
        if loaded.visible.shape != tracks.visible.shape:
            part = "" if arguments.live is None else f"the first {tracks.n_frames} views of "
            raise InputError(
                f"{arguments.result}: holds {loaded.n_frames} images and {loaded.n_points} points, expected those of "
                f"{part}{arguments.tracks} ({tracks.n_frames} and {tracks.n_points})"
            )
        return loaded
    tracks, _ = check_reconstructable(tracks, str(arguments.tracks))
    try:
        reconstruction, _ = METHODS["connrsfm"](tracks, resolved(arguments), progress)
    except InputError as error:
        raise InputError(f"{arguments.tracks}: {error}") from error
    return reconstruction
