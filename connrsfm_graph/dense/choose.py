"""Which way to a dense depth map suits the data: the network or the spline."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Protocol

import numpy as np

from connrsfm_graph.dense.sparse import SparsePoints
from connrsfm_graph.dense.spline_depth import SplineDepth
from connrsfm_graph.errors import InputError, missing_package

METHODS = ("network", "spline")


class DepthMethod(Protocol):
    """A way from the sparse points of several images to their depth maps."""

    name: str

    def depth(self, number: int, size: tuple[int, int]) -> np.ndarray:
        """(H, W) depth of every pixel of image `number`, of `size` (W, H)."""
        ...

    def depth_at(self, number: int, pixels: np.ndarray) -> np.ndarray:
        """(N,) depth at places (N, 2) of image `number`."""
        ...


@dataclass(frozen=True)
class Choice:
    """A method and why it was chosen."""

    method: DepthMethod
    reason: str
    checkpoint: str | None = None
    """Name of the network's checkpoint."""
    warnings: tuple[str, ...] = ()
    """One sentence each, for the user."""


def choose(images: Sequence[SparsePoints], wanted: str | None = None, checkpoint: str | Path | None = None) -> Choice:
    """The method asked for, or the one of smaller cross-validated error; the spline where the network does not apply.

    Args:
        images: sparse points of all images.
        wanted: name of a method, None for the choice from the data.
        checkpoint: file of a trained network; the shipped one where None.

    Raises:
        InputError: no such method, or the network was asked for and torch or the checkpoint cannot be had.
    """
    if wanted not in (None, *METHODS):
        raise InputError(f"method '{wanted}' is unknown, expected one of {', '.join(METHODS)}")
    if wanted == "spline":
        return Choice(SplineDepth(images), "as asked for")
    if wanted is None and checkpoint is None and find_spec("torch") is None:
        return Choice(SplineDepth(images), "the network needs torch, which is not installed")
    require_torch()
    from connrsfm_graph.dense.checkpoint import SHIPPED, Checkpoint
    from connrsfm_graph.dense.network_depth import NetworkDepth, unfit

    file = Path(checkpoint or SHIPPED)
    trained = Checkpoint.load(file)
    outside = unfit(trained, images)
    if wanted == "network":
        warnings = () if outside is None else (f"the network may be wrong here: {outside}",)
        return Choice(NetworkDepth(trained, images), "as asked for", file.name, warnings)
    spline = SplineDepth(images)
    if outside is not None:
        return Choice(spline, outside)
    network = NetworkDepth(trained, images)
    errors = f"{100 * network.expected_error:.3f} % for the network, {100 * spline.expected_error:.3f} % for the spline"
    reason = f"cross-validated error of depth {errors}"
    if network.expected_error < spline.expected_error:
        return Choice(network, reason, file.name)
    return Choice(spline, reason)


def require_torch() -> None:
    """Raise `InputError` where torch is not installed."""
    if find_spec("torch") is None:
        raise missing_package("the network", "torch", "dense")
