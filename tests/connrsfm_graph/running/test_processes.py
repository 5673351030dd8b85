"""Worker processes give what this process gives, also where one of them dies."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Iterator

import pytest

from connrsfm_graph.errors import ComputationError
from connrsfm_graph.running.block import Block, Finished
from connrsfm_graph.running.processes import Processes


def number(finished: Finished) -> int:
    return int(finished.process.rpartition(":")[2])


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@pytest.mark.slow
def test_a_killed_worker_is_replaced(work, check):
    def answers() -> Iterator[Finished]:
        for n, finished in enumerate(Processes(2).work(work.guide, work.blocks)):
            if n < 2:
                os.kill(number(finished), signal.SIGKILL)
            yield finished

    found = list(answers())
    check(found)
    assert len({finished.process for finished in found}) > 2
    assert os.getpid() not in map(number, found)
    assert all(finished.peak_memory_mib > 50 for finished in found)


def test_errors_arrive_and_workers_end(work):
    block = work.blocks[0]
    blocks = [block, Block(2, block.image[:, :5], block.visible[:, :5])]
    answers = Processes(1).work(work.guide, blocks)
    worker = number(next(answers))
    assert alive(worker)
    with pytest.raises(ValueError, match="mismatch") as caught:
        next(answers)
    assert "reconstruct_others" in caught.value.__notes__[0]
    assert not alive(worker)


def test_a_run_that_is_given_up_leaves_no_worker(work):
    answers = Processes(1).work(work.guide, work.blocks)
    worker = number(next(answers))
    answers.close()
    assert not alive(worker)


def test_workers_that_cannot_live_are_given_up(work, monkeypatch):
    monkeypatch.setattr(sys, "executable", "/bin/false")
    started = time.perf_counter()
    with pytest.raises(ComputationError, match="3 worker processes died"):
        list(Processes(2).work(work.guide, work.blocks))
    assert time.perf_counter() - started < 30
