"""Who works on the blocks, and in which sizes: what the settings, the machine and the memory allow."""

from __future__ import annotations

from collections.abc import Generator, Iterable
from dataclasses import dataclass
from typing import Protocol

import numba

from connrsfm_graph.others import Guide
from connrsfm_graph.running.block import Block, Finished, work_on
from connrsfm_graph.running.config import RunningConfig

WORTH_STARTING = 60_000
"""Points in all images that follow keyframes from which on processes beat threads. On two cores, a process takes 1.4 s
to start and 300 points 0.05 s, and two of them are 1.9 times as fast as one thread, where two threads are 1.5 times."""
_OWN = 300 * 2**20
"""Memory of a process before it has work: libraries and compiled code."""
RESULT_BYTES = 8 * 17 + 3
"""Of a point in an image of the result."""


class Crew(Protocol):
    """Whoever works on blocks; entered before the first stage, so that what is missing is found at once."""

    def __enter__(self) -> Crew: ...

    def __exit__(self, *_: object) -> None: ...

    def work(self, guide: Guide, blocks: Iterable[Block]) -> Generator[Finished, None, None]:
        """The blocks, in any order."""
        ...


class Here:
    """This process, with its threads."""

    def __enter__(self) -> Here:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def work(self, guide: Guide, blocks: Iterable[Block]) -> Generator[Finished, None, None]:
        for block in blocks:
            yield work_on(guide, block)


@dataclass(frozen=True)
class Plan:
    """What a run may take."""

    workers: int
    """Processes, 1 for this one alone."""
    block: int
    """Images in a block."""
    on_disk: bool
    """Whether the result lies on disk while it grows."""

    @staticmethod
    def of(config: RunningConfig, n_frames: int, n_following: int, n_points: int) -> Plan:
        """Shares of the memory: a quarter for the result, a half for processes at work."""
        memory = config.memory()
        workers = config.workers
        if workers is None:
            workers = numba.get_num_threads() if n_following * n_points >= WORTH_STARTING else 1
        image = memory_of_an_image(n_points)
        affordable = int(0.5 * memory / (_OWN + image))
        workers = max(1, min(workers, affordable, -(-n_following // config.block)))
        room = 0.5 * memory / workers - (_OWN if workers > 1 else 0)
        return Plan(
            workers=workers,
            block=max(1, min(config.block, int(room / image))),
            on_disk=n_frames * n_points * RESULT_BYTES > 0.25 * memory,
        )


def memory_of_an_image(n_points: int) -> float:
    """Bytes that an image of a block takes at its peak, a little more than measured for 100 to 1500 points: warps and
    their covariances grow with the points, the matrices of the refinement with points times the mesh's width."""
    return 12e3 * n_points + 400.0 * n_points**1.5


def assembled(config: RunningConfig, plan: Plan) -> Crew:
    """The crew.

    Raises:
        InputError: the cluster cannot be used.
    """
    if config.cluster is not None:
        from connrsfm_graph.running.cluster import Cluster

        return Cluster(config.cluster)
    if plan.workers > 1:
        from connrsfm_graph.running.processes import Processes

        return Processes(plan.workers)
    return Here()
