"""What must not become slow: starting, and a small reconstruction. Limits are on processor time, with room."""

from __future__ import annotations

import resource
import subprocess
import sys
import time

import pytest

from connrsfm_graph.reconstruct import reconstruct
from connrsfm_graph.synthetic import isometric_bending
from connrsfm_graph.tracks import check_reconstructable

ROOM = 2.0


def processor_seconds(*command: str) -> float:
    """Of a process and its children."""

    def used() -> float:
        usage = resource.getrusage(resource.RUSAGE_CHILDREN)
        return usage.ru_utime + usage.ru_stime

    before = used()
    subprocess.run(command, check=True, capture_output=True)
    return used() - before


def test_help_is_quick():
    assert min(processor_seconds(sys.executable, "-m", "connrsfm_graph", "--help") for _ in range(3)) < 0.5 * ROOM


def test_import_is_quick_and_compiles_nothing():
    code = (
        "import factors.conformal_pair, connrsfm_graph.reconstruct as r, connrsfm_graph.solvers.batched as b;"
        "from numba.core.dispatcher import Dispatcher;"
        "compiled = [f for f in vars(b).values() if isinstance(f, Dispatcher) and f.overloads];"
        "assert not compiled, compiled"
    )
    processor_seconds(sys.executable, "-c", code)
    assert min(processor_seconds(sys.executable, "-c", "import connrsfm_graph") for _ in range(3)) < 1.0 * ROOM


@pytest.mark.slow
def test_a_small_sequence_takes_seconds_in_a_warm_process():
    def seconds() -> float:
        tracks = isometric_bending(10, 85, smooth=True).tracks
        start = time.process_time()
        reconstruct(check_reconstructable(tracks)[0])
        return time.process_time() - start

    assert min(seconds() for _ in range(2)) < 3.0 * ROOM
