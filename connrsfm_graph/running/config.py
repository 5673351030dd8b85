"""Settings of how a run is carried out; no result depends on them."""

from __future__ import annotations

import math
import os
import re
from dataclasses import dataclass

from connrsfm_graph.errors import InputError

_UNITS = {"": 1, "b": 1}
_UNITS |= {f"{letter}ib": 2 ** (10 * power) for power, letter in enumerate("kmgt", 1)}
_UNITS |= {f"{letter}b": 10 ** (3 * power) for power, letter in enumerate("kmgt", 1)}
_LEAST_MEMORY = 2**29


@dataclass(frozen=True)
class RunningConfig:
    """How the images that follow the keyframes are shared out, and what that may take."""

    workers: int | None = None
    """Processes that work on blocks of images; none: as many as there are threads, where there are images enough to be
    worth starting them. With one the blocks are worked on one after the other, with threads inside."""
    cluster: str | None = None
    """Address of a Dask scheduler, such as tcp://host:8786, whose workers take the blocks; none: this machine."""
    memory_limit: str | None = None
    """Memory for all processes of the run on this machine, such as 4GiB: blocks and the number of workers are chosen to
    fit, and a large result lies on disk while it grows. none: three quarters of the machine's memory."""
    block: int = 32
    """Images in a block, at most."""

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise InputError(f"running.workers is {self.workers}, expected at least 1, or none")
        if self.block < 1:
            raise InputError(f"running.block is {self.block}, expected at least 1")
        if self.cluster is not None and not re.fullmatch(r"[a-z+]+://.+", self.cluster):
            raise InputError(f"running.cluster is '{self.cluster}', expected an address such as tcp://host:8786")
        if self.memory_limit is not None and parsed_size(self.memory_limit) < _LEAST_MEMORY:
            raise InputError(f"running.memory_limit is {self.memory_limit}, expected at least 512MiB")

    def memory(self) -> float:
        """The limit in bytes; infinite where neither the user nor the system says."""
        if self.memory_limit is not None:
            return parsed_size(self.memory_limit)
        try:
            return 0.75 * os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        except (AttributeError, ValueError, OSError):
            return math.inf


def parsed_size(text: str) -> int:
    """Bytes of a size such as 4GiB, 512 MiB or 2e9.

    Raises:
        InputError: not a size.
    """
    match = re.fullmatch(r"\s*([0-9.]+(?:e[0-9]+)?)\s*([a-z]*)\s*", text.lower())
    try:
        if match is not None:
            return int(float(match[1]) * _UNITS[match[2]])
    except (KeyError, ValueError):
        pass
    raise InputError(f"running.memory_limit: '{text}' is no size, expected a number with a unit such as 4GiB or 500MB")
