"""Benchmarks measure what they say, once, and go on where they were."""

from __future__ import annotations

import csv

import numpy as np
import pytest

from connrsfm_graph.solvers.batched import BatchedBackend
from experiments.benchmarks.__main__ import main
from experiments.benchmarks.iteration import ACTIVE, DAMPING, NOISE, bending_problem, measure_iteration
from experiments.benchmarks.table import FAILURE, Table, machine
from factors.conformal_pair import SLOTS


def test_a_row_is_measured_once_and_a_failure_again(tmp_path):
    def broken() -> dict[str, float]:
        raise RuntimeError("broken\nfor good")

    table = Table(tmp_path, "t", ("size",))
    table.measure({"size": 1}, lambda: {"seconds": 0.5})
    table.measure({"size": 2}, broken)
    table.write({"size": lambda row: str(row["size"]), "s": lambda row: f"{row['seconds']:.1f}"})
    assert (tmp_path / "t.md").read_text().splitlines()[-2:] == ["| 1 | 0.5 |", "| 2 | broken for good |"]
    assert machine() in (tmp_path / "t.md").read_text()
    again = Table(tmp_path, "t", ("size",))
    again.measure({"size": 1}, broken)
    again.measure({"size": 2}, lambda: {"seconds": 0.7})
    assert [(row["size"], row["seconds"], row[FAILURE]) for row in again.rows] == [(1, 0.5, ""), (2, 0.7, "")]


@pytest.mark.parametrize("active", ACTIVE.values(), ids=ACTIVE)
def test_torch_takes_the_same_step(active):
    pytest.importorskip("torch")
    from experiments.benchmarks.torch_step import make_step

    problem, state = bending_problem(5, 7)
    after = BatchedBackend().step(problem, state, active, NOISE, damping=DAMPING)
    columns = [column for letter in "dc" if letter in active for column in range(*SLOTS[letter][0])]
    step = make_step(problem, state, active, NOISE, DAMPING)().numpy()
    np.testing.assert_allclose(step, (after.frame - state.frame)[..., columns], atol=1e-8)


@pytest.mark.slow
def test_iterations_are_compared(tmp_path):
    measure_iteration(tmp_path, frames=6, points=8, repeats=1)
    with (tmp_path / "iteration.csv").open() as file:
        rows = list(csv.DictReader(file))
    ratio = {(row["iteration"], row["solver"]): float(row["times batched"]) for row in rows}
    assert {name for name, _ in ratio} == set(ACTIVE)
    assert ratio["joint", "batched"] == 1.0
    assert ratio["joint", "GTSAM"] > 3
    assert ratio["joint", "scipy TRF per point"] > 10


@pytest.mark.slow
def test_the_pipeline_is_measured_against_the_truth(tmp_path):
    assert main(["pipeline", "--sizes", "6x30", "--out", str(tmp_path)]) == 0
    with (tmp_path / "pipeline.csv").open() as file:
        (row,) = csv.DictReader(file)
    assert row[FAILURE] == ""
    assert float(row["3D error %"]) < 0.1
    assert float(row["peak MiB"]) > 50
    stages = ("warps", "solve", "refinement", "surfaces", "other images")
    assert 0.5 * float(row["seconds"]) < sum(float(row[name]) for name in stages) <= float(row["seconds"])
