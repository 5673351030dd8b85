"""Train the network that turns normals into depth, on simulated surfaces."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

_SETTINGS = (
    ("variant", str, "compact (the default), densenet169 or resnet50"),
    ("steps", int, "batches in all"),
    ("batch", int, "surfaces per batch"),
    ("size", int, "pixels per side of the images, a multiple of 32"),
    ("noise", float, "largest noise on the normals, 0 for none"),
    ("rate", float, "largest step size of the optimiser"),
    ("held_out", int, "surfaces that it is evaluated on"),
    ("seed", int, "seed of weights and surfaces"),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--out", type=Path, required=True, metavar="CKPT", help="checkpoint to write; goes on from CKPT.state if there"
    )
    for name, kind, meaning in _SETTINGS:
        parser.add_argument(f"--{name.replace('_', '-')}", type=kind, help=meaning)
    parser.add_argument("--device", default="cpu", help="cpu, or cuda for a GPU (default: %(default)s)")


def run(arguments: argparse.Namespace) -> None:
    from connrsfm_graph.dense.choose import require_torch

    require_torch()
    import torch

    from connrsfm_graph.dense.train import TrainConfig, train
    from connrsfm_graph.errors import InputError
    from connrsfm_graph.progress import Progress

    if arguments.device not in ("cpu", "cuda") or (arguments.device == "cuda" and not torch.cuda.is_available()):
        raise InputError(f"--device {arguments.device}: not available, expected cpu, or cuda where there is a GPU")
    given = {name: getattr(arguments, name) for name, _, _ in _SETTINGS}
    config = TrainConfig(**{name: value for name, value in given.items() if value is not None})
    progress = Progress()
    with progress.stage("train"):
        train(config, arguments.out, arguments.device, progress.update, lambda line: print(line, file=sys.stderr))
    print(arguments.out)
