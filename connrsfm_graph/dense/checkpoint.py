"""Trained networks as files: weights, what they were trained on and how well they did.

A checkpoint is what `torch.save` makes of a dictionary of tensors and plain values, and is read with `weights_only`, so
that opening one runs no code. Weights of convolutions are kept in half precision.
"""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from connrsfm_graph.dense.network import DepthNetwork, make_network
from connrsfm_graph.errors import InputError
from connrsfm_graph.files import require_file, written_beside

FORMAT = 1
SHIPPED = Path(__file__).with_name("compact.pt")
"""The checkpoint that comes with the package; `compact.md` beside it says how it was made."""


@dataclass(frozen=True)
class Checkpoint:
    """A trained network and its card."""

    network: DepthNetwork
    """In evaluation mode."""
    variant: str
    """Name in `network.VARIANTS`."""
    size: int
    """Pixels per side of its images."""
    slope_range: float
    """Largest root mean square slope of log depth over the window that it was trained on."""
    card: dict[str, Any]
    """How it was trained (`configuration`, `step`) and its errors on held-out surfaces (`history`)."""

    def save(self, path: str | Path) -> None:
        """Write the checkpoint."""
        weights = {
            name: value.half() if value.is_floating_point() and value.ndim > 1 else value
            for name, value in self.network.state_dict().items()
        }
        content = {
            "format": FORMAT,
            "variant": self.variant,
            "size": self.size,
            "slope_range": self.slope_range,
            "card": self.card,
            "weights": {name: value.cpu() for name, value in weights.items()},
        }
        with written_beside(path) as part:
            torch.save(content, part)

    @staticmethod
    def load(path: str | Path) -> Checkpoint:
        """Read a checkpoint, onto the processor.

        Raises:
            InputError: no such file, not a checkpoint of a depth network, or of another format.
        """
        content = read_tensors(path)
        missing = {"format", "variant", "size", "slope_range", "card", "weights"} - content.keys()
        if missing:
            raise InputError(f"{path}: not a checkpoint of 'train-depth' ({', '.join(sorted(missing))} missing)")
        if content["format"] != FORMAT:
            raise InputError(f"{path}: checkpoint of format {content['format']}, this version reads {FORMAT}")
        network = make_network(content["variant"], seed=0)
        try:
            network.load_state_dict({name: value.float() for name, value in content["weights"].items()})
        except RuntimeError as error:
            raise InputError(f"{path}: its weights are not those of the network '{content['variant']}'") from error
        return Checkpoint(network.eval(), content["variant"], content["size"], content["slope_range"], content["card"])


def card_text(checkpoint: Checkpoint) -> str:
    """The card of a checkpoint as Markdown: the command that makes it again, and its errors while it was trained."""
    settings, history = checkpoint.card["configuration"], checkpoint.card["history"]
    named = ("variant", "steps", "batch", "size", "noise", "rate", "seed")
    options = " ".join(f"--{name} {settings[name]}" for name in named if settings[name] is not None)
    parameters = sum(parameter.numel() for parameter in checkpoint.network.parameters())
    lines = [
        f"# Depth network `{checkpoint.variant}`, {parameters:,} parameters",
        "",
        f"    connrsfm train-depth --out CKPT {options}",
        "",
        f"Mean relative error of depth on {settings['held_out']} simulated surfaces held out, in percent, with clean",
        "normals and with noise of 20 % on the normals, while it was trained:",
        "",
        "| step | loss | clean | noisy |",
        "|---|---|---|---|",
    ]
    for row in history:
        lines.append(f"| {row['step']} | {row['loss']:.4f} | {100 * row['clean']:.2f} | {100 * row['noisy']:.2f} |")
    return "\n".join(lines) + "\n"


def read_tensors(path: str | Path) -> dict[str, Any]:
    """The dictionary in a file of `torch.save`.

    Raises:
        InputError: no such file, or it holds anything but tensors and plain values.
    """
    path = Path(path)
    require_file(path)
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, pickle.UnpicklingError, EOFError, KeyError, ValueError, OSError) as error:
        raise InputError(f"{path}: cannot be read as a checkpoint (damaged or of another format)") from error
    if not isinstance(content, dict):
        raise InputError(f"{path}: holds no dictionary, expected a checkpoint of 'train-depth'")
    return content
