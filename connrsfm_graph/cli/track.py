"""Follow points through images or a video."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("images", type=Path, metavar="IMAGES", help="folder of images, or a video")
    parser.add_argument(
        "--intrinsics", required=True, metavar="K", help="fx,fy,cx,cy in pixels or a text file with a 3 x 3 matrix"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="NPZ", help="file for the tracks")
    parser.add_argument("--masks", type=Path, metavar="IMAGES", help="images that are not black where the object is")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="one setting of the tracker, such as points=500 or every=2; may be repeated",
    )


def run(arguments: argparse.Namespace) -> None:
    from connrsfm_graph.config import override
    from connrsfm_graph.errors import InputError
    from connrsfm_graph.files import check_output_folder
    from connrsfm_graph.progress import Progress
    from connrsfm_graph.tracks import parse_intrinsics, save_tracks
    from connrsfm_graph.tracks.follow import TrackingConfig, track_images

    if arguments.out.suffix.lower() != ".npz":
        raise InputError(f"--out {arguments.out}: expected a name that ends in .npz")
    check_output_folder(arguments.out.parent)
    config = override(TrackingConfig(), arguments.set)
    K = parse_intrinsics(arguments.intrinsics)
    progress = Progress()
    with progress.stage("track"):
        tracks = track_images(arguments.images, K, config, masks=arguments.masks, progress=progress.update)
    save_tracks(arguments.out, tracks)
    print(
        f"{arguments.out}: {tracks.n_points} points in {tracks.n_frames} images, "
        f"{100 * tracks.visible.mean():.0f} % visible"
    )
