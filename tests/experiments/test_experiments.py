"""The experiments as listed: what they would run, without running it."""

from __future__ import annotations

from pathlib import Path

import pytest

from connrsfm_graph.methods import METHODS
from experiments.__main__ import EXPERIMENTS, TABLES, main
from experiments.study import SEED, Experiment, Options


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A folder that seems to hold all data sets."""
    for name in ("tshirt.npz", "flag.npz", "kinect_paper.npz"):
        (tmp_path / name).touch()
    return tmp_path


@pytest.mark.parametrize("experiment", TABLES, ids=lambda experiment: experiment.name)
def test_cases_are_distinct_and_runnable(experiment: Experiment, data: Path) -> None:
    cases = list(experiment.cases(Options(data, data)))
    columns = list(cases[0].keys)
    assert len({tuple(map(str, case.keys.values())) for case in cases}) == len(cases)
    assert all(list(case.keys) == columns for case in cases)
    assert {case.method for case in cases} <= set(METHODS)
    assert experiment.x is None or experiment.x in columns
    named = {tuple(str(value) for key, value in case.keys.items() if key != SEED) for case in cases}
    assert set(experiment.published) <= named, "a published figure stands beside no line"


@pytest.mark.parametrize("experiment", TABLES, ids=lambda experiment: experiment.name)
def test_random_experiments_have_five_seeds_and_one_in_a_quick_run(experiment: Experiment, data: Path) -> None:
    for quick, wanted in ((False, 5), (True, 1)):
        seeds: dict[tuple[str, ...], int] = {}
        for case in experiment.cases(Options(data, data, quick)):
            group = tuple(str(value) for key, value in case.keys.items() if key != SEED)
            seeds[group] = seeds.get(group, 0) + (SEED in case.keys)
        assert set(seeds.values()) <= {0, 1, wanted}


def test_without_data_the_synthetic_experiments_remain(tmp_path: Path) -> None:
    options = Options(tmp_path / "nothing", tmp_path)
    runnable = {experiment.name for experiment in TABLES if list(experiment.cases(options))}
    assert runnable == {experiment.name for experiment in TABLES} - {"tshirt", "flag", "kinect_paper"}


def test_the_command_line_knows_every_experiment(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["no_such_experiment"])
    assert stop.value.code == 2
    others = {"theorem", "cloth", "truth", "dense", "accuracy", "slam", "summary"}
    assert {experiment.name for experiment in TABLES} | others == set(EXPERIMENTS)


def test_a_named_experiment_writes_into_the_folder(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    assert main(["theorem", "--out", str(tmp_path / "results")]) == 0
    assert (tmp_path / "results" / "theorem.csv").exists()


@pytest.mark.slow
def test_the_quick_set_runs_without_any_data(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    pytest.importorskip("clarabel", reason="the extra 'baselines' is not installed")
    pytest.importorskip("torch", reason="the extra 'dense' is not installed")
    assert main(["quick", "--data", str(tmp_path / "nothing"), "--out", str(tmp_path)]) == 0
    written = {path.stem for path in (tmp_path / "quick").glob("*.md")}
    training = {"dense_compact_0", "dense_compact_0.25"}
    assert written == set(EXPERIMENTS) - {"tshirt", "flag", "kinect_paper", "cloth", "truth"} | training
    assert "| Synthetic 1 | **" in (tmp_path / "quick" / "summary.md").read_text()
