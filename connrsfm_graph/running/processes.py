"""Blocks shared out among processes of this machine.

A thread for each worker hands it one block after the other. A worker that dies is replaced and its block is worked on
again; workers end with the process that started them, however that ends.
"""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Generator, Iterable
from contextlib import suppress
from queue import SimpleQueue
from threading import Lock, Thread
from typing import Any

from connrsfm_graph.errors import ComputationError
from connrsfm_graph.others import Guide
from connrsfm_graph.running.block import Block, Finished

_ATTEMPTS = 3
"""Workers that a block may outlive."""
_ONE_THREAD = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Processes:
    """Workers on this machine."""

    def __init__(self, number: int) -> None:
        self.number = number

    def __enter__(self) -> Processes:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def work(self, guide: Guide, blocks: Iterable[Block]) -> Generator[Finished, None, None]:
        """The blocks in the order in which they are finished.

        Raises:
            ComputationError: workers die again and again.
        """
        team = _Team(pickle.dumps(guide, protocol=pickle.HIGHEST_PROTOCOL), blocks)
        threads = [Thread(target=team.member, daemon=True) for _ in range(self.number)]
        try:
            for thread in threads:
                thread.start()
            at_work = len(threads)
            while at_work:
                answer = team.answers.get()
                if isinstance(answer, BaseException):
                    raise answer
                if answer is None:
                    at_work -= 1
                else:
                    yield answer
        finally:
            team.stop()


class _Team:
    """What the threads share."""

    def __init__(self, guide: bytes, blocks: Iterable[Block]) -> None:
        self.answers: SimpleQueue[Finished | BaseException | None] = SimpleQueue()
        """Finished blocks, errors, and None when a thread ends."""
        self._guide = guide
        self._blocks = iter(blocks)
        self._taking, self._starting = Lock(), Lock()
        self._processes: list[subprocess.Popen[bytes]] = []
        self._stopped = False

    def member(self) -> None:
        """One thread: a worker and its blocks."""
        worker: subprocess.Popen[bytes] | None = None
        try:
            while (block := self._next_block()) is not None:
                for _ in range(_ATTEMPTS):
                    worker = worker or self._start()
                    if worker is None:
                        return
                    answer = self._ask(worker, block)
                    if answer is not None:
                        break
                    worker = None
                else:
                    raise ComputationError(
                        f"{_ATTEMPTS} worker processes died over the same images; out of memory? Give fewer --workers"
                    )
                self.answers.put(answer)
        except BaseException as error:
            self.answers.put(error)
        finally:
            if worker is not None and worker.stdin is not None:
                worker.stdin.close()
            self.answers.put(None)

    def stop(self) -> None:
        """End all workers."""
        with self._starting:
            self._stopped = True
            for process in self._processes:
                process.kill()
        for process in self._processes:
            process.wait()

    def _next_block(self) -> Block | None:
        with self._taking:
            return None if self._stopped else next(self._blocks, None)

    def _start(self) -> subprocess.Popen[bytes] | None:
        """A worker; None where all are to end."""
        environment = os.environ | dict.fromkeys(_ONE_THREAD, "1")
        environment["PYTHONPATH"] = os.pathsep.join(path or os.getcwd() for path in sys.path)
        with self._starting:
            if self._stopped:
                return None
            worker = subprocess.Popen(
                [sys.executable, "-m", "connrsfm_graph.running.worker"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                env=environment,
                start_new_session=True,  # Ctrl-C is for this process, which ends its workers
            )
            self._processes.append(worker)
        assert worker.stdin is not None
        with suppress(OSError):  # where it has died already, the first question says so
            worker.stdin.write(self._guide)
        return worker

    @staticmethod
    def _ask(worker: subprocess.Popen[bytes], block: Block) -> Any:
        """The worker's answer, None where it died."""
        assert worker.stdin is not None
        assert worker.stdout is not None
        try:
            pickle.dump(block, worker.stdin, protocol=pickle.HIGHEST_PROTOCOL)
            worker.stdin.flush()
            return pickle.load(worker.stdout)
        except (OSError, EOFError, pickle.UnpicklingError):
            worker.kill()
            return None
