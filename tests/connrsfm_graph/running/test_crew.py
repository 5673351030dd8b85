"""Who works, in which blocks, and where the result lies."""

from __future__ import annotations

import numba
import pytest

from connrsfm_graph.errors import InputError
from connrsfm_graph.running.config import RunningConfig, parsed_size
from connrsfm_graph.running.crew import WORTH_STARTING, Here, Plan, assembled
from connrsfm_graph.running.processes import Processes


@pytest.mark.parametrize(
    ("text", "size"), [("4GiB", 4 * 2**30), ("512 MiB", 2**29), ("2e9", 2e9), ("1.5gb", 1.5e9), ("7", 7)]
)
def test_sizes(text, size):
    assert parsed_size(text) == size


@pytest.mark.parametrize("text", ["", "much", "4 GiBs", "1.2.3", "-1GB"])
def test_no_sizes(text):
    with pytest.raises(InputError, match="is no size"):
        parsed_size(text)


@pytest.mark.parametrize(
    "settings", [{"workers": 0}, {"block": 0}, {"memory_limit": "100MB"}, {"cluster": "host"}, {"memory_limit": "x"}]
)
def test_settings_out_of_range(settings):
    with pytest.raises(InputError, match="expected"):
        RunningConfig(**settings)


def test_a_large_result_lies_on_disk():
    config = RunningConfig(memory_limit="1GiB")
    assert not Plan.of(config, 1000, 960, 300).on_disk
    assert Plan.of(config, 10000, 9960, 300).on_disk


def test_blocks_and_workers_fit_the_memory():
    roomy = Plan.of(RunningConfig(workers=4, memory_limit="64GiB"), 8000, 7960, 300)
    assert (roomy.workers, roomy.block) == (4, 32)
    tight = Plan.of(RunningConfig(workers=4, memory_limit="1GiB"), 8000, 7960, 300)
    assert tight.workers == 1
    many_points = Plan.of(RunningConfig(memory_limit="1GiB"), 8000, 7960, 3000)
    assert 1 <= many_points.block < 32


def test_processes_are_started_for_long_sequences_only(monkeypatch):
    monkeypatch.setattr(numba, "get_num_threads", lambda: 2)
    config = RunningConfig(memory_limit="16GiB")
    assert isinstance(assembled(config, Plan.of(config, 100, 60, 300)), Here)
    following = WORTH_STARTING // 300
    long = Plan.of(config, following + 40, following, 300)
    assert isinstance(assembled(config, long), Processes)
    assert long.workers == 2
    assert Plan.of(RunningConfig(workers=8), 50, 10, 300).workers == 1  # one block
