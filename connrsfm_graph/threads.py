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


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, thread_name_prefix="connrsfm")


def over_views(kernel: Callable[..., None], n_views: int, *arguments: Any) -> None:
    """Call kernel(first, last, *arguments) on ranges that cover all views, one range per thread.

    The kernel writes into its arguments, each view's part separately, so the result does not depend on the number of
    threads, which is numba's (`NUMBA_NUM_THREADS`).
    """
    threads = max(1, min(n_views, numba.get_num_threads()))
    if threads == 1:
        kernel(0, n_views, *arguments)
        return
    bounds = [n_views * n // threads for n in range(threads + 1)]
    own, *others = pairwise(bounds)
    tasks = [_pool(threads).submit(kernel, a, b, *arguments) for a, b in others]
    kernel(*own, *arguments)
    for task in tasks:
        task.result()


def mapped(function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """function(item) of every item, in order. It pays where most time goes to code that releases the interpreter."""
    if numba.get_num_threads() == 1:
        return map(function, items)
    return _pool(numba.get_num_threads()).map(function, items)
