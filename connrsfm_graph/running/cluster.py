"""Blocks shared out among the workers of an existing Dask cluster (extra `cluster`)."""

from __future__ import annotations

import pickle
from collections.abc import Generator, Iterable
from itertools import islice
from threading import Lock
from typing import Any

from connrsfm_graph.errors import ComputationError, InputError, missing_package
from connrsfm_graph.others import Guide
from connrsfm_graph.run_record import package_versions
from connrsfm_graph.running.block import Block, Finished, work_on

_SECONDS = 10
"""Within which the scheduler must answer."""
_AHEAD = 2
"""Blocks that wait at each worker, so that none is idle while an answer travels."""
_ONE_AT_A_TIME = Lock()


class Cluster:
    """The workers of a Dask scheduler; blocks of a worker that is lost go to the others."""

    def __init__(self, address: str) -> None:
        """
        Raises:
            InputError: dask.distributed is not installed, no scheduler answers, it has no workers, or these have other
                versions of the packages that compute.
        """
        try:
            from distributed import Client
        except ImportError as error:
            raise missing_package("running on a cluster", "dask.distributed", "cluster") from error
        try:
            self._client = Client(address, timeout=_SECONDS, set_as_default=False)
        except (OSError, TimeoutError, ValueError) as error:
            raise InputError(
                f"cluster {address}: no Dask scheduler answers there within {_SECONDS} seconds; is 'dask scheduler' "
                "running?"
            ) from error
        try:
            self._client.wait_for_workers(1, timeout=_SECONDS)
        except TimeoutError as error:
            self._client.close()
            raise InputError(
                f"cluster {address}: the scheduler has no workers; start some with 'dask worker'"
            ) from error
        here = package_versions()
        for worker, there in self._client.run(_versions).items():
            for package, version in here.items():
                if there.get(package) != version:
                    self._client.close()
                    raise InputError(
                        f"cluster {address}: {worker} has {package} {there.get(package)}, expected {version} as here, "
                        "so that results do not depend on who works"
                    )

    def __enter__(self) -> Cluster:
        return self

    def __exit__(self, *_: object) -> None:
        self._client.close()

    def work(self, guide: Guide, blocks: Iterable[Block]) -> Generator[Finished, None, None]:
        """The blocks in the order in which they are finished.

        Raises:
            ComputationError: the scheduler gives a block up because its workers die.
        """
        from distributed import KilledWorker, as_completed

        # The result of a task is made again where the workers that hold it are lost; scattered data would be gone.
        known = self._client.submit(_unpacked, pickle.dumps(guide), pure=False)
        blocks = iter(blocks)
        threads = sum(self._client.nthreads().values())
        first = [self._submitted(known, block) for block in islice(blocks, _AHEAD * threads)]
        under_way: Any = as_completed(first, loop=self._client.loop)
        for future in under_way:
            try:
                finished = future.result()
            except KilledWorker as error:
                raise ComputationError("the cluster's workers died over the same images; out of memory?") from error
            for block in islice(blocks, 1):
                under_way.add(self._submitted(known, block))
            yield finished

    def _submitted(self, known: Any, block: Block) -> Any:
        return self._client.submit(_worked_on, known, block, pure=False)


def _versions() -> dict[str, str]:
    """Of a worker."""
    return package_versions()


def _unpacked(guide: bytes) -> Guide:
    unpacked = pickle.loads(guide)
    assert isinstance(unpacked, Guide)
    return unpacked


def _worked_on(guide: Guide, block: Block) -> Finished:
    """A worker may have threads; compiled code that has its own runs once at a time."""
    with _ONE_AT_A_TIME:
        return work_on(guide, block)
