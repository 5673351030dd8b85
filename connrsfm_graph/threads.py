"""Work shared out among threads: compiled kernels on ranges of views, and functions that mostly wait for such code."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import Any, TypeVar

import numba

Item = TypeVar("Item")
Result = TypeVar("Result")

_RANGES = 4
"""Of views, for every thread."""


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    """Threads that work alone: what one of them calls is not shared out again."""
    return ThreadPoolExecutor(threads, "connrsfm", initializer=numba.set_num_threads, initargs=(1,))


def over_views(kernel: Callable[..., None], n_views: int, *arguments: Any) -> None:
    """Call kernel(first, last, *arguments) on ranges that cover all views, a few for every thread.

    The kernel writes into its arguments, each view's part separately, so the result does not depend on the number of
    threads, which is numba's (`NUMBA_NUM_THREADS`). Threads that are done early take over ranges of the others.
    """
    threads = max(1, min(n_views, numba.get_num_threads()))
    if threads == 1:
        kernel(0, n_views, *arguments)
        return
    count = min(n_views, _RANGES * threads)
    ranges = iter(list(pairwise(n_views * n // count for n in range(count + 1))))

    def work() -> None:
        for first, last in ranges:  # each is handed out once: the interpreter's lock is held meanwhile
            kernel(first, last, *arguments)

    tasks = [_pool(threads).submit(work) for _ in range(threads - 1)]
    work()
    for task in tasks:
        task.result()


def mapped(function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """function(item) of every item, in order, each on a thread of its own; what it calls `over_views` stays there.

    It pays where most time goes to code that releases the interpreter. Of many small views it makes better use of the
    threads than sharing out the views of one item after the other. A single item has all threads.
    """
    items = list(items)
    if numba.get_num_threads() == 1 or len(items) == 1:
        return map(function, items)
    return _pool(numba.get_num_threads()).map(function, items)
