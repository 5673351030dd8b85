"""Benchmarks measure what they say, once, and go on where they were."""

from __future__ import annotations

import csv

import numba
import numpy as np
import pytest

from connrsfm_graph.errors import InputError
from connrsfm_graph.solvers.batched import BatchedBackend
from experiments.benchmarks.__main__ import main
from experiments.benchmarks.iteration import ACTIVE, DAMPING, NOISE, bending_problem, measure_iteration
from experiments.benchmarks.publish import MARKS, publish
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


def test_pages_show_what_was_measured(tmp_path):
    pages = [tmp_path / "page.md", tmp_path / "project.md"]
    for page in pages:
        page.write_text("before\n" + "\nold\n".join(MARKS) + "\nafter\n")
    with pytest.raises(InputError, match="holds no benchmark"):
        publish(tmp_path, *pages)
    sizes, solvers = Table(tmp_path, "pipeline", ("images", "points")), Table(tmp_path, "iteration", ("solver",))
    row = {"seconds": 2.5, "peak MiB": 512, "3D error %": 0.001}
    sizes.measure({"images": 10, "points": 85}, lambda: row)
    sizes.write({"s": lambda row: str(row["seconds"])})
    for times, solver in ((1, "batched"), (42, "GTSAM"), (540, "scipy TRF per point")):
        joint = {"iteration": "joint", "images": 9, "points": 8, "seconds": 0.5 * times, "times batched": times}
        solvers.measure({"solver": solver}, lambda joint=joint: joint)
    solvers.write({"s": lambda row: str(row["seconds"])})
    publish(tmp_path, *pages)
    tables, sentences = (page.read_text() for page in pages)
    assert all(
        "old" not in text and text.startswith("before") and text.endswith("after\n") for text in (tables, sentences)
    )
    assert tables.index("benchmarks pipeline`: " + machine()) < tables.index("| 2.5 |") < tables.index("| 270.0 |")
    assert "10 x 85 in 2.5 s" in sentences
    assert "in GTSAM 42 times, scipy's TRF per point 540 times that" in " ".join(sentences.split())


@pytest.mark.slow
def test_iterations_are_compared(tmp_path):
    threads = numba.get_num_threads()
    numba.set_num_threads(1)  # so little work waits for threads where the machine has other work
    try:
        measure_iteration(tmp_path, frames=6, points=8, repeats=5)
    finally:
        numba.set_num_threads(threads)
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
