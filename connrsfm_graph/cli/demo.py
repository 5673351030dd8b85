"""Render a deforming surface, track it, reconstruct it, make it dense and report: needs no data."""

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
    from connrsfm_graph.cli.evaluate import evaluated
    from connrsfm_graph.cli.reconstruct import reconstruct_into
    from connrsfm_graph.dense.densify import densify
    from connrsfm_graph.dense.layout import DENSE_FOLDER, SEQUENCE_FILE
    from connrsfm_graph.files import check_output_folder, folder_written_beside
    from connrsfm_graph.progress import Progress
    from connrsfm_graph.reconstruction import Reconstruction
    from connrsfm_graph.report.page import write_report
    from connrsfm_graph.run_record import RunRecord
    from connrsfm_graph.synthetic.rendered import render_sequence
    from connrsfm_graph.tracks import save_tracks
    from connrsfm_graph.tracks.front_end import images_to_tracks
    from connrsfm_graph.tracks.images import write_image

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
            write_image(file, image)
        with progress.stage("track"):
            tracked = images_to_tracks(files, sequence.K, progress=progress.update)
        tracks = sequence.truth_for(tracked.tracks)
        save_tracks(part / TRACKS_FILE, tracks)
    source = str(out / TRACKS_FILE)
    reconstruct_into(out, tracks, source, config, progress, report=False)
    reconstruction = Reconstruction.load(out)
    with progress.stage("densify"):
        densify(reconstruction, out / IMAGES_FOLDER, out, method="spline", progress=progress.update)
    with progress.stage("report"):
        evaluation, truth = evaluated(reconstruction, tracks, source)
        page = write_report(out, reconstruction, RunRecord.load(out), truth, evaluation, sequence.images)
    print(f"{out / DENSE_FOLDER / SEQUENCE_FILE}: the textured surfaces, for any viewer of 3D models")
    print(f"{page}: open it in a browser")
