"""Render a deforming surface, track it, reconstruct it and report: needs no data."""

from __future__ import annotations

import argparse
from pathlib import Path

from connrsfm_graph.cli.settings import add_configuration, resolved

IMAGES_FOLDER = "images"
TRACKS_FILE = "tracks.npz"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for everything the demo makes")
    add_configuration(parser)


def run(arguments: argparse.Namespace) -> None:
    import cv2

    from connrsfm_graph.cli.reconstruct import reconstruct_into
    from connrsfm_graph.files import check_output_folder, folder_written_beside
    from connrsfm_graph.progress import Progress
    from connrsfm_graph.synthetic.rendered import render_sequence
    from connrsfm_graph.tracks import save_tracks
    from connrsfm_graph.tracks.front_end import images_to_tracks

    out = check_output_folder(arguments.out)
    config = resolved(arguments)
    progress = Progress()
    with progress.stage("render"):
        sequence = render_sequence(progress=progress.update)
    with folder_written_beside(out) as part:
        folder = part / IMAGES_FOLDER
        folder.mkdir()
        files = [folder / f"{number:03d}.png" for number in range(len(sequence.images))]
        for file, image in zip(files, sequence.images, strict=True):
            cv2.imwrite(str(file), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
        with progress.stage("track"):
            tracked = images_to_tracks(files, sequence.K, progress=progress.update)
        tracks = sequence.truth_for(tracked.tracks)
        save_tracks(part / TRACKS_FILE, tracks)
    reconstruct_into(out, tracks, str(out / TRACKS_FILE), config, progress, images=list(sequence.images))
