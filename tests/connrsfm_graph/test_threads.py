"""Work shared out among threads."""

from __future__ import annotations

import threading

import numba
import numpy as np
import pytest

from connrsfm_graph.threads import mapped, over_views


def count(first: int, last: int, values: np.ndarray, out: np.ndarray, threads: set[str]) -> None:
    """A kernel in Python."""
    out[first:last] = values[first:last] + 1.0
    threads.add(threading.current_thread().name)


@pytest.mark.parametrize("n_views", [1, 3, 100])
def test_ranges_cover_every_view_once(n_views: int) -> None:
    values, out = np.arange(float(n_views)), np.full(n_views, np.nan)
    over_views(count, n_views, values, out, set())
    np.testing.assert_array_equal(out, values + 1.0)


@pytest.mark.skipif(numba.config.NUMBA_NUM_THREADS < 2, reason="there is one thread only")
def test_what_has_a_thread_of_its_own_stays_there() -> None:
    """Where it would wait for threads that wait for others, nothing would ever end."""

    def work(item: int) -> tuple[int, set[str], list[int]]:
        threads: set[str] = set()
        over_views(count, 8, np.zeros(8), np.zeros(8), threads)
        return item, threads, list(mapped(lambda n: n + item, range(3)))

    found = list(mapped(work, range(20)))
    assert [item for item, _, _ in found] == list(range(20))
    assert all(len(threads) == 1 and threads.pop().startswith("connrsfm") for _, threads, _ in found)
    assert [inner for _, _, inner in found] == [[item, item + 1, item + 2] for item in range(20)]
    assert numba.get_num_threads() > 1


def test_a_single_item_has_all_threads() -> None:
    assert list(mapped(lambda _: numba.get_num_threads(), range(1))) == [numba.get_num_threads()]
