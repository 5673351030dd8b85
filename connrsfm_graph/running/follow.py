"""The images that follow keyframes, block by block: those that are finished are read, the others worked on and kept."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing

from connrsfm_graph.others import Guide, Others
from connrsfm_graph.progress import Progress
from connrsfm_graph.running.block import Block, this_process
from connrsfm_graph.running.checkpoints import Checkpoints
from connrsfm_graph.running.crew import Crew, Plan
from connrsfm_graph.running.gather import Gathering
from connrsfm_graph.tracks import Tracks


def follow_keyframes(
    tracks: Tracks,
    guide: Guide,
    gathering: Gathering,
    crew: Crew,
    plan: Plan,
    checkpoints: Checkpoints,
    progress: Progress,
) -> dict[str, float]:
    """Add all images that follow keyframes to the result; returns the peak memory, in MiB, of other processes by name.

    Args:
        tracks: of all images.
        guide: the keyframes.
        gathering: the result, which has the keyframes.
        crew: who works on the blocks.
        plan: in which sizes.
        checkpoints: where finished blocks are kept.
        progress: shows how many images are done.
    """
    total, done = len(gathering.following), 0
    missing: list[int] = []
    peaks: dict[str, float] = {}

    def came(first: int, others: Others) -> None:
        nonlocal done
        gathering.add(first, others)
        done += len(others.keyframe)
        progress.update(done, total)

    for first in range(0, total, plan.block):
        others = checkpoints.find(block_name(first, min(first + plan.block, total)), Others)
        if others is None:
            missing.append(first)
        else:
            came(first, others)

    def blocks() -> Iterator[Block]:
        for first in missing:
            part = tracks.select(frames=gathering.following[first : first + plan.block])
            yield Block(first, part.normalised(), part.visible)

    with closing(crew.work(guide, blocks())) as answers:
        for finished in answers:
            last = finished.first + len(finished.others.keyframe)
            checkpoints.keep(block_name(finished.first, last), finished.others)
            came(finished.first, finished.others)
            peaks[finished.process] = finished.peak_memory_mib
    peaks.pop(this_process(), None)
    return peaks


def block_name(first: int, last: int) -> str:
    """Of the checkpoint of a block."""
    return f"images-{first:06d}-{last:06d}"
