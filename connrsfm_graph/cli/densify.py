"""Make dense textured surfaces of a result from its images."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("result", type=Path, metavar="DIR", help="folder of a result")
    parser.add_argument(
        "--images", type=Path, required=True, metavar="IMAGES", help="folder or video of the images that were tracked"
    )
    parser.add_argument(
        "--method", choices=("network", "spline"), help="way to dense depth (default: of smaller cross-validated error)"
    )
    parser.add_argument("--checkpoint", type=Path, metavar="CKPT", help="trained network (default: the one shipped)")


def run(arguments: argparse.Namespace) -> None:
    from connrsfm_graph.dense.densify import densify
    from connrsfm_graph.dense.layout import DENSE_FOLDER, INDEX_FILE
    from connrsfm_graph.errors import InputError
    from connrsfm_graph.progress import Progress
    from connrsfm_graph.reconstruction import Reconstruction

    out = arguments.result
    if out.exists() and not out.is_dir():
        raise InputError(f"{out}: is a file, expected the folder that 'reconstruct' wrote")
    reconstruction = Reconstruction.load(out)
    if not reconstruction.camera.kappa:
        raise InputError(f"{out}: was seen by an orthographic camera, densify needs a perspective one")
    progress = Progress()
    with progress.stage("densify"):
        index = densify(reconstruction, arguments.images, out, arguments.method, arguments.checkpoint, progress.update)
    for warning in index.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    print(f"{out / DENSE_FOLDER / INDEX_FILE}: {len(index.frames)} surfaces by {index.method} ({index.reason})")
