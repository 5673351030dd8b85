"""A block of images to reconstruct, and what whoever did it hands back."""

from __future__ import annotations

import os
import platform
from dataclasses import dataclass

import numpy as np
from threadpoolctl import threadpool_limits

from connrsfm_graph.others import Guide, Others, reconstruct_others
from connrsfm_graph.run_record import peak_memory_mib


@dataclass(frozen=True)
class Block:
    """Images that follow the keyframes, next to each other among those that do."""

    first: int
    """Place of the first of them among all that follow."""
    image: np.ndarray
    """(B, P, 2) normalised coordinates."""
    visible: np.ndarray
    """(B, P) bool."""


@dataclass(frozen=True)
class Finished:
    """A block that was worked on."""

    first: int
    """Place of its first image among all that follow keyframes."""
    others: Others
    """Its surfaces."""
    process: str
    """Machine and number of the process that did it."""
    peak_memory_mib: float
    """Largest resident memory of that process so far."""


def work_on(guide: Guide, block: Block) -> Finished:
    """Reconstruct a block."""
    with threadpool_limits(limits=1, user_api="blas"):
        others = reconstruct_others(guide, block.image, block.visible)
    return Finished(block.first, others, this_process(), peak_memory_mib())


def this_process() -> str:
    """Machine and number of this process."""
    return f"{platform.node()}:{os.getpid()}"
