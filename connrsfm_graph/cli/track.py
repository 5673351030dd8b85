"""Follow points through images or a video."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np

    from connrsfm_graph.tracks import Tracks


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("images", type=Path, metavar="IMAGES", help="folder of images, or a video")
    parser.add_argument(
        "--intrinsics", required=True, metavar="K", help="fx,fy,cx,cy in pixels or a text file with a 3 x 3 matrix"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="NPZ", help="file for the tracks")
    parser.add_argument("--masks", type=Path, metavar="IMAGES", help="images that are not black where the object is")
    parser.add_argument(
        "--distortion", metavar="D", help="k1,k2,p1,p2[,k3] of the lens; the tracks are those of a lens without"
    )
    parser.add_argument(
        "--keyframes", type=int, metavar="N", help="keep N images, spread evenly over the motion (default: all)"
    )
    parser.add_argument("--picture", type=Path, metavar="PNG", help="draw the tracks on some of the images")
    parser.add_argument(
        "--save-images",
        type=Path,
        metavar="DIR",
        help="write the images that the tracks belong to, without lens distortion, for densify and report",
    )
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="one setting of the tracker, such as points=500, every=2 or last=300; may be repeated",
    )


def run(arguments: argparse.Namespace) -> None:
    from dataclasses import replace

    from connrsfm_graph.config import override
    from connrsfm_graph.errors import InputError
    from connrsfm_graph.files import check_output_folder
    from connrsfm_graph.progress import Progress
    from connrsfm_graph.tracks import parse_intrinsics, save_tracks
    from connrsfm_graph.tracks.config import TrackingConfig
    from connrsfm_graph.tracks.front_end import images_to_tracks
    from connrsfm_graph.tracks.lens import parse_distortion

    for option, path, ending in (("--out", arguments.out, ".npz"), ("--picture", arguments.picture, ".png")):
        if path is not None:
            if path.suffix.lower() != ending:
                raise InputError(f"{option} {path}: expected a name that ends in {ending}")
            check_output_folder(path.parent)
    saved = arguments.save_images
    if saved is not None and check_output_folder(saved).resolve() == arguments.images.resolve():
        raise InputError(f"--save-images {saved}: is the folder of the images, expected another")
    config = override(TrackingConfig(), arguments.set)
    K = parse_intrinsics(arguments.intrinsics)
    distortion = None if arguments.distortion is None else parse_distortion(arguments.distortion)
    progress = Progress()
    with progress.stage("track"):
        tracked = images_to_tracks(
            arguments.images, K, config, arguments.masks, distortion, arguments.keyframes, progress.update
        )
    tracks = tracked.tracks
    if saved is not None:
        names = _save_images(saved, _images(arguments.images, tracks, distortion), tracks)
        tracks = replace(tracks, image_names=names)
    if arguments.picture is not None:
        _save_picture(arguments.picture, _images(arguments.images, tracked.tracks, distortion), tracks)
    save_tracks(arguments.out, tracks)
    print(
        f"{arguments.out}: {tracks.n_points} points in {tracks.n_frames} images, "
        f"{100 * tracks.visible.mean():.0f} % visible; {tracked.wrong} wrong tracks dropped"
    )


def _images(source: Path, tracks: Tracks, distortion: np.ndarray | None) -> Iterator[np.ndarray]:
    """The images that tracks belong to, as a lens without distortion would have taken them."""
    from connrsfm_graph.tracks.images import images_of
    from connrsfm_graph.tracks.lens import undistort_image

    images = images_of(source, tracks.image_names, tracks.n_frames)
    return images if distortion is None else (undistort_image(image, tracks.K[0], distortion) for image in images)


def _save_images(folder: Path, images: Iterator[np.ndarray], tracks: Tracks) -> tuple[str, ...]:
    """Write images as PNG into a folder and return their new names."""
    from connrsfm_graph.files import folder_written_beside
    from connrsfm_graph.tracks.images import png_name, write_image

    given = tracks.image_names or [str(frame) for frame in range(tracks.n_frames)]
    names = tuple(png_name(name) for name in given)
    with folder_written_beside(folder) as part:
        for name, image in zip(names, images, strict=True):
            write_image(part / name, image)
    return names


def _save_picture(path: Path, images: Iterator[np.ndarray], tracks: Tracks) -> None:
    from connrsfm_graph.files import written_beside
    from connrsfm_graph.tracks.draw import draw_sequence
    from connrsfm_graph.tracks.images import write_image

    with written_beside(path) as part:
        write_image(part, draw_sequence(images, tracks))
