"""A Dask scheduler with two worker processes on this machine gives what this process gives."""

from __future__ import annotations

import os
import signal
import socket
import sys
from collections.abc import Iterator

import pytest

from connrsfm_graph.errors import InputError
from connrsfm_graph.running.block import Finished
from connrsfm_graph.running.cluster import Cluster


@pytest.fixture(scope="module")
def scheduler() -> Iterator[str]:
    """Address of a scheduler with two worker processes."""
    distributed = pytest.importorskip("distributed")
    local = distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None, silence_logs=50)
    with local:
        yield local.scheduler_address


@pytest.mark.slow
def test_workers_of_another_version_are_refused(scheduler, monkeypatch):
    monkeypatch.setattr("connrsfm_graph.running.cluster.package_versions", lambda: {"numpy": "0.9"})
    with pytest.raises(InputError, match=r"has numpy 2.*, expected 0\.9 as here"):
        Cluster(scheduler)


@pytest.mark.slow
def test_a_killed_worker_of_the_cluster_costs_nothing(work, check, scheduler):
    with Cluster(scheduler) as crew:

        def answers() -> Iterator[Finished]:
            for n, finished in enumerate(crew.work(work.guide, work.blocks)):
                if n == 0:
                    os.kill(int(finished.process.rpartition(":")[2]), signal.SIGKILL)
                yield finished

        found = list(answers())
    check(found)
    assert len({finished.process for finished in found}) >= 2


def test_no_scheduler_is_said_in_time(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("connrsfm_graph.running.cluster._SECONDS", 1)
    with socket.socket() as taken:  # bound but not listening: refused
        taken.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(InputError, match=f"cluster {address}: no Dask scheduler answers there within 1 s"):
            Cluster(address)


def test_a_missing_package_is_said(monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(InputError, match="install the extra 'cluster'"):
        Cluster("tcp://127.0.0.1:8786")
