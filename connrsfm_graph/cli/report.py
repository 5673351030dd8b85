"""Build the page of a result again."""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("result", type=Path, metavar="DIR", help="folder of a result")
    parser.add_argument("--truth", type=Path, metavar="TRACKS", help="tracks file with true points, to show errors")
    parser.add_argument("--images", type=Path, metavar="IMAGES", help="folder or video to draw the tracks on")


def run(arguments: argparse.Namespace) -> None:
    from connrsfm_graph.cli.evaluate import evaluated
    from connrsfm_graph.errors import InputError
    from connrsfm_graph.reconstruction import Reconstruction, RunRecord
    from connrsfm_graph.report.page import write_report
    from connrsfm_graph.tracks import load_tracks
    from connrsfm_graph.tracks.images import images_of

    out = arguments.result
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file, expected the folder that 'reconstruct' wrote")
    reconstruction, record = Reconstruction.load(out), RunRecord.load(out)
    truth = evaluation = images = None
    if arguments.truth is not None:
        tracks = load_tracks(arguments.truth, camera=reconstruction.camera.name)
        evaluation, truth = evaluated(reconstruction, tracks, str(arguments.truth))
    if arguments.images is not None:
        names = None if reconstruction.image_names is None else reconstruction.image_names.tolist()
        images = images_of(arguments.images, names, reconstruction.n_frames)
    print(write_report(out, reconstruction, record, truth, evaluation, images))
