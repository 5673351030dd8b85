"""Build the page of a result again, and other pictures of it."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterator

    import numpy as np


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("result", type=Path, metavar="DIR", help="folder of a result")
    parser.add_argument("--truth", type=Path, metavar="TRACKS", help="tracks file with true points, to show errors")
    parser.add_argument(
        "--images", type=Path, metavar="IMAGES", help="folder or video that was tracked, to texture the surfaces"
    )
    parser.add_argument(
        "--renders", type=int, metavar="WIDTH", help="also draw every surface as PNG files of this width in pixels"
    )
    parser.add_argument(
        "--view", default="30,18", metavar="RIGHT,UP", help="degrees from which they are seen (default: %(default)s)"
    )
    parser.add_argument("--rerun", type=Path, metavar="RRD", help="also write a recording for the viewer rerun")


def run(arguments: argparse.Namespace) -> None:
    from connrsfm_graph.cli.evaluate import evaluated
    from connrsfm_graph.errors import InputError
    from connrsfm_graph.progress import Progress
    from connrsfm_graph.reconstruction import Reconstruction
    from connrsfm_graph.report.page import write_report
    from connrsfm_graph.report.recording import write_recording
    from connrsfm_graph.report.renders import write_renders
    from connrsfm_graph.run_record import RunRecord
    from connrsfm_graph.tracks import load_tracks
    from connrsfm_graph.tracks.images import images_of

    out = arguments.result
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file, expected the folder that 'reconstruct' wrote")
    if arguments.renders is not None and not 16 <= arguments.renders <= 8192:
        raise InputError(f"--renders {arguments.renders}: expected a width of 16 to 8192 pixels")
    seen_from = _angles(arguments.view)
    reconstruction, record = Reconstruction.load(out), RunRecord.load(out)
    truth = evaluation = None
    if arguments.truth is not None:
        tracks = load_tracks(arguments.truth, camera=reconstruction.camera.name)
        evaluation, truth = evaluated(reconstruction, tracks, str(arguments.truth))
    names = None if reconstruction.image_names is None else reconstruction.image_names.tolist()

    def images() -> Iterator[np.ndarray] | None:
        if arguments.images is None:
            return None
        return images_of(arguments.images, names, reconstruction.n_frames)

    progress = Progress()
    if arguments.rerun is not None:
        with progress.stage("recording"):
            print(write_recording(arguments.rerun, out, reconstruction, truth, images()))
    with progress.stage("report"):
        print(write_report(out, reconstruction, record, truth, evaluation, images()))
    if arguments.renders is not None:
        with progress.stage("renders"):
            print(write_renders(out, reconstruction, arguments.renders, seen_from, truth, images(), progress.update))


def _angles(text: str) -> tuple[float, float]:
    from connrsfm_graph.errors import InputError

    try:
        right, up = (float(word) for word in text.split(","))
    except ValueError:
        raise InputError(f"--view {text}: expected two numbers, degrees to the right and up") from None
    if not (abs(right) <= 360 and abs(up) <= 90):
        raise InputError(f"--view {text}: expected at most 360 degrees to the right and 90 up")
    return right, up
