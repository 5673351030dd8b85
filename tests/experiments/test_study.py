"""The shared runner: resumption, averages, failures, tables."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from connrsfm_graph.synthetic import isometric_bending
from connrsfm_graph.tracks import Tracks
from experiments import study
from experiments.study import Case, Experiment, Options, group, markdown, read_rows
from experiments.summary import SOURCES, summarise


@pytest.fixture
def options(tmp_path: Path) -> Options:
    return Options(data=tmp_path / "nothing", out=tmp_path / "results", quick=True)


def few() -> Tracks:
    return isometric_bending(n_frames=3, n_points=25).tracks


def too_few() -> Tracks:
    return few().select(points=range(5))


def cases(options: Options) -> Iterable[Case]:
    for seed in (0, 1):
        yield Case({"method": "infp", "seed": seed}, few, "infp")
    yield Case({"method": "on 5 points", "seed": 0}, too_few, "infp")


TINY = Experiment("tiny", "A tiny experiment", cases, published={("infp",): "2.49"})


def row(method: str, seed: int, error: float) -> dict[str, str]:
    figures = dict.fromkeys(study.MEASURES, str(error))
    return {"method": method, "seed": str(seed), **figures, "failure": ""}


@pytest.fixture(autouse=True)
def _no_compilation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(study, "compile_kernels", lambda: None)


def test_an_experiment_writes_table_and_figure_and_goes_on_where_it_was(
    options: Options, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("matplotlib")
    TINY(options)
    first = (options.out / "tiny.csv").read_text()
    assert len(read_rows(options.out / "tiny.csv")) == 3
    assert "| infp | 2/2 |" in (options.out / "tiny.md").read_text()
    assert "| on 5 points | 0/1 | fails |" in (options.out / "tiny.md").read_text()
    assert (options.out / "tiny.png").stat().st_size > 5_000

    def ran(case: Case) -> dict[str, str]:
        raise AssertionError(f"{case.keys} was run again")

    monkeypatch.setattr(study, "run", ran)
    TINY(options)
    assert (options.out / "tiny.csv").read_text() == first


def test_only_missing_cases_are_run(options: Options) -> None:
    pytest.importorskip("matplotlib")
    TINY(options)
    path = options.out / "tiny.csv"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:2]))
    TINY(options)
    assert [found["seed"] for found in read_rows(path)] == ["0", "1", "0"]
    assert path.read_text().startswith("".join(lines[:2]))


def test_runs_are_averaged_over_seeds() -> None:
    (each,) = group([row("a", 0, 1.0), row("a", 1, 3.0)], ("method", "seed"))
    assert each.keys == {"method": "a"}
    assert each.runs == 2
    assert each.mean["e3d_percent"] == 2.0
    assert each.spread["e3d_percent"] == pytest.approx(np.sqrt(2.0))


def test_the_table_shows_the_published_figure_beside_ours() -> None:
    text = markdown(TINY, group([row("infp", 0, 2.0), row("b", 0, 1.0)], ("method", "seed")))
    ours, other = text.splitlines()[-2:]
    assert ours.startswith("| infp | 1/1 | 2.000 |")
    assert ours.endswith("| 2.49 |")
    assert other.endswith("|  |")


def test_absent_data_are_skipped_with_a_line(options: Options, capsys: pytest.CaptureFixture[str]) -> None:
    replace(TINY, cases=lambda options: [])(options)
    assert "tiny: skipped, its data are not in" in capsys.readouterr().err
    assert not (options.out / "tiny.csv").exists()


def test_the_summary_says_where_the_default_mode_is_behind(options: Options) -> None:
    options.out.mkdir()
    for method, error in (("default", 0.5), ("mlh", 0.4)):
        study.append_row(options.out / f"{SOURCES[0].name}.csv", row(method, 0, error))
    summarise(options)
    text = (options.out / "summary.md").read_text()
    assert "**0.40**" in text
    assert "mlh ahead of our default mode" in text


def test_errors_that_print_alike_are_a_tie(options: Options) -> None:
    options.out.mkdir()
    for method, error in (("default", 2e-5), ("mlh", 1e-7)):
        study.append_row(options.out / f"{SOURCES[0].name}.csv", row(method, 0, error))
    summarise(options)
    text = (options.out / "summary.md").read_text()
    assert text.count("**0.00**") == 2
    assert "Our default mode is ahead on every line." in text
