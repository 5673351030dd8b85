"""Reconstruct the surface of every image from tracks."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from connrsfm_graph.cli.settings import add_configuration, resolved

if TYPE_CHECKING:
    import numpy as np

    from connrsfm_graph.progress import Progress
    from connrsfm_graph.reconstruct import Config
    from connrsfm_graph.reconstruction import Reconstruction
    from connrsfm_graph.run_record import RunRecord
    from connrsfm_graph.tracks import Tracks

CONFIG_FILE = "config.toml"
DEFAULT_METHOD = "connrsfm"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("tracks", type=Path, metavar="TRACKS", help=".npz, .mat or .csv file of point tracks")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the result")
    parser.add_argument(
        "--intrinsics", metavar="K", help="fx,fy,cx,cy or a text file with a 3 x 3 matrix, instead of the file's own"
    )
    parser.add_argument(
        "--camera",
        choices=("perspective", "orthographic"),
        help="how a pixel sees, instead of what the file says (perspective where it says nothing); for an orthographic "
        "camera fx, fy are pixels per unit of length",
    )
    parser.add_argument("--method", default=DEFAULT_METHOD, help="method or baseline (default: %(default)s)")
    add_configuration(parser)
    parser.add_argument("--images", type=Path, metavar="IMAGES", help="the images that were tracked, for the page")
    parser.add_argument("--no-report", action="store_true", help="write no page with pictures")
    add_running(parser)
    parser.add_argument(
        "--resume",
        action="store_true",
        help="go on with a run that was interrupted, from what it left in DIR.partial; the result is the same",
    )


def add_running(parser: argparse.ArgumentParser) -> None:
    """Options of how a run is carried out, each short for a setting."""
    for option, metavar, what in (
        ("--workers", "N", "processes that share out the images of a long sequence"),
        ("--cluster", "ADDRESS", "Dask scheduler, such as tcp://host:8786, whose workers do so instead"),
        ("--memory-limit", "SIZE", "memory that the run may take on this machine, such as 4GiB"),
    ):
        key = f"running.{option.strip('-').replace('-', '_')}"
        parser.add_argument(
            option,
            dest="set",
            action="append",
            type=f"{key}={{}}".format,
            metavar=metavar,
            help=f"{what} (setting {key})",
        )


def run(arguments: argparse.Namespace) -> None:
    from connrsfm_graph.files import check_output_folder
    from connrsfm_graph.progress import Progress
    from connrsfm_graph.tracks import load_tracks
    from connrsfm_graph.tracks.images import images_of

    check_output_folder(arguments.out)
    config = resolved(arguments)
    tracks = load_tracks(arguments.tracks, arguments.intrinsics, arguments.camera)
    images = None
    if arguments.images is not None:
        images = images_of(arguments.images, tracks.image_names, tracks.n_frames)
    reconstruct_into(
        arguments.out,
        tracks,
        str(arguments.tracks),
        config,
        Progress(),
        method=arguments.method,
        report=not arguments.no_report,
        images=images,
        resume=arguments.resume,
    )


def reconstruct_into(
    out: Path,
    tracks: Tracks,
    source: str,
    config: Config,
    progress: Progress,
    method: str = DEFAULT_METHOD,
    report: bool = True,
    images: Iterable[np.ndarray] | None = None,
    resume: bool = False,
) -> None:
    """Reconstruct, write everything into `out` and say what came of it.

    The result is in place before the page is made, so an interrupted page costs no result. Until then what is finished
    is kept in a folder beside it, from which `resume` goes on.
    """
    from connrsfm_graph.config import as_toml
    from connrsfm_graph.errors import InputError
    from connrsfm_graph.files import folder_written_beside
    from connrsfm_graph.methods import METHODS
    from connrsfm_graph.reconstruction import RESULT_FILE
    from connrsfm_graph.report.page import remove_report
    from connrsfm_graph.run_record import RECORD_FILE
    from connrsfm_graph.running.checkpoints import Checkpoints
    from connrsfm_graph.tracks import check_reconstructable

    if method not in METHODS:
        raise InputError(f"--method {method}: no such method, expected one of {', '.join(METHODS)}")
    tracks, hints = check_reconstructable(tracks, source)
    checkpoints = Checkpoints()
    run: Callable[..., tuple[Reconstruction, RunRecord]] = METHODS[method]
    if method == DEFAULT_METHOD:
        checkpoints = Checkpoints.beside(out, tracks, config, resume)
        run = partial(run, checkpoints=checkpoints)
    elif resume:
        raise InputError(f"--resume: only the method {DEFAULT_METHOD} leaves something to go on from")
    try:
        with checkpoints.told_on_error():
            reconstruction, record = run(tracks, config, progress)
    except InputError as error:
        raise InputError(f"{source}: {error}") from error
    warnings = tuple(dict.fromkeys((*hints, *record.warnings)))
    record = replace(record, source=source, method=method, warnings=warnings)
    with folder_written_beside(out) as part:
        reconstruction.save(part / RESULT_FILE)
        record.save(part / RECORD_FILE)
        (part / CONFIG_FILE).write_text(as_toml(config), encoding="utf-8")
    checkpoints.remove()
    remove_report(out)
    for warning in warnings:
        print(f"warning: {warning}", file=sys.stderr)
    evaluation, truth = None, tracks.points
    if truth is not None:
        from connrsfm_graph.cli.evaluate import evaluated, summary

        try:
            with progress.stage("evaluation"):  # of thousands of images it takes as long as the run
                evaluation, truth = evaluated(reconstruction, tracks, source)
            print(summary(evaluation))
        except InputError as error:  # the result stands, whatever is wrong with the truth
            print(f"warning: not evaluated: {error}", file=sys.stderr)
            truth = None
    written = [RESULT_FILE, RECORD_FILE, CONFIG_FILE]
    if report:
        from connrsfm_graph.report.page import write_report

        with progress.stage("report"):
            page = write_report(out, reconstruction, record, truth, evaluation, images)
        written.append(page.name)
    print(f"{out}: {', '.join(written)}")
