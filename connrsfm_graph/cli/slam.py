"""Camera trajectory and deforming map in one world frame, from tracks and, if there is any, odometry.

Writes trajectory.tum (camera to world), map.ply (points of all views, with the numbers of view and point), and
problem.npz (what was fused, to load in Python).
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from connrsfm_graph.cli.settings import add_configuration, resolved

if TYPE_CHECKING:
    from connrsfm_graph.progress import Progress
    from connrsfm_graph.reconstruction import Reconstruction

TRAJECTORY_FILE, MAP_FILE, PROBLEM_FILE = "trajectory.tum", "map.ply", "problem.npz"


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
    parser.add_argument("--intrinsics", metavar="K", help="camera of the tracks, instead of the file's own")
    add_configuration(parser)


def run(arguments: argparse.Namespace) -> None:
    import numpy as np

    from connrsfm_graph.errors import InputError
    from connrsfm_graph.files import check_output_folder, folder_written_beside
    from connrsfm_graph.progress import Progress
    from connrsfm_graph.slam import (
        FusionConfig,
        MapModel,
        Sightings,
        SlamConfig,
        pose_problem,
        read_tum,
        save_problem,
        solve_problem,
        write_map,
        write_tum,
    )
    from connrsfm_graph.slam.trajectory import steps_between
    from connrsfm_graph.tracks import load_tracks

    out = check_output_folder(arguments.out)
    config = SlamConfig(
        FusionConfig(MapModel(motion=arguments.motion)), arguments.odometry_translation, arguments.odometry_rotation
    )
    times, odometry = (None, None) if arguments.odometry is None else read_tum(arguments.odometry)
    background = None
    if arguments.background is not None:
        tracked = load_tracks(arguments.background, arguments.intrinsics)
        background = np.nan_to_num(tracked.normalised()), tracked.visible
    progress = Progress()
    sightings = Sightings.of(_reconstruction(arguments, progress))
    if odometry is not None and len(odometry) != sightings.n_views:
        raise InputError(
            f"{arguments.odometry}: holds {len(odometry)} poses, expected one per view, {sightings.n_views}"
        )
    with progress.stage("noise levels"):
        steps = None if odometry is None else steps_between(odometry)
        first = None if odometry is None else odometry[0]
        problem = pose_problem(sightings, config, None, steps, background, first)
    with progress.stage("fusion"):
        fused = solve_problem(problem, config.fusion, progress.update)
    with folder_written_beside(out) as part:
        write_tum(part / TRAJECTORY_FILE, fused.poses, times)
        write_map(part / MAP_FILE, fused)
        save_problem(part / PROBLEM_FILE, problem)
    unit = "of odometry" if odometry is not None else "of the first view's reconstruction"
    print(f"{len(fused.poses)} poses and {np.isfinite(fused.points).all(axis=-1).sum()} map points, in the unit {unit}")
    print(f"{out}: {TRAJECTORY_FILE}, {MAP_FILE}, {PROBLEM_FILE}")


def _reconstruction(arguments: argparse.Namespace, progress: Progress) -> Reconstruction:
    """The one given, or one made now."""
    from connrsfm_graph.errors import InputError
    from connrsfm_graph.methods import METHODS
    from connrsfm_graph.reconstruction import Reconstruction
    from connrsfm_graph.tracks import check_reconstructable, load_tracks

    tracks = load_tracks(arguments.tracks, arguments.intrinsics)
    if arguments.result is not None:
        loaded = Reconstruction.load(arguments.result)
        if loaded.visible.shape != tracks.visible.shape:
            raise InputError(
                f"{arguments.result}: holds {loaded.n_frames} images and {loaded.n_points} points, expected those of "
                f"{arguments.tracks} ({tracks.n_frames} and {tracks.n_points})"
            )
        return loaded
    tracks, _ = check_reconstructable(tracks, str(arguments.tracks))
    try:
        reconstruction, _ = METHODS["connrsfm"](tracks, resolved(arguments), progress)
    except InputError as error:
        raise InputError(f"{arguments.tracks}: {error}") from error
    return reconstruction
