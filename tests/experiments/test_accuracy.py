"""The accuracy table: what is run, what counts as reached, and where the table goes."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from connrsfm_graph.errors import InputError
from connrsfm_graph.reconstruct import reconstruct
from connrsfm_graph.synthetic import moebius, spheres
from experiments import accuracy
from experiments.study import read_rows
from experiments.verdict import DEFAULT, PAPER, RUNS, START, Target, misses, table


def line(error: float = 0.2, shape: float = 2.0, seed: int = 0, **other: str) -> dict[str, str]:
    """A line of the CSV."""
    empty = dict.fromkeys(("alternative_error", "alternative_shape", "precision", "recall", "scale", "failure"), "")
    figures = {"error": str(error), "shape": str(shape), "floor": "0.5", "model": "isometric", "seed": str(seed)}
    return empty | figures | other


def missed(target: Target, default: dict[str, str], start: float = 1.0, paper: float = 1.0) -> list[str]:
    runs = {("x", DEFAULT): [default], ("x", START): [line(start)], ("x", PAPER): [line(paper)]}
    return misses(target, runs)


def test_what_falls_short_is_named() -> None:
    target = Target(name="x", bound=(0.3, 3.0), model="isometric")
    assert missed(target, line()) == []
    assert missed(target, line(0.31)) == ["3D error"]
    assert missed(target, line(shape=3.1)) == ["shape error"]
    assert missed(target, line(shape=3.1, floor="3.05")) == ["shape error, 3.05 for the truth itself"]
    assert missed(target, line(model="conformal")) == ["model"]
    assert missed(target, line(), start=0.1) == ["worse than before refinement on seed 0"]
    assert missed(target, line(), paper=0.1) == ["worse than paper mode on seed 0"]
    assert missed(target, line(precision="0.89", recall="0.91")) == ["precision"]


def test_a_reported_alternative_counts_unless_views_are_declared() -> None:
    ambiguous = line(2.0, 20.0, alternative_error="0.2", alternative_shape="2", scale="0.5")
    assert missed(Target(name="x", bound=(0.3, 3.0)), ambiguous) == []
    declared = Target(name="x", bound=(0.3, 3.0), isometric_views=(0, 1))
    assert missed(declared, ambiguous, start=9.0, paper=9.0) == ["3D error", "shape error", "scale"]


def test_wrong_tracks_are_measured_by_the_row_without() -> None:
    target = Target(name="x", clean="y")
    runs = {("x", DEFAULT): [line(0.27)], ("y", DEFAULT): [line(0.2)]}
    assert misses(target, runs) == ["3D error"]
    assert misses(target, runs | {("x", DEFAULT): [line(0.25)]}) == []
    assert "| 0.260 / 2.00 | 0.26 |" in table([target], runs | {("x", DEFAULT): [line(0.26)]})


def test_rows_have_names_of_their_own_and_bounds_that_can_be_missed() -> None:
    assert len({row.name for row in accuracy.ROWS}) == len(accuracy.ROWS)
    for row in accuracy.ROWS:
        assert math.isfinite(row.bound[0]) or row.clean in {other.name for other in accuracy.ROWS}


def test_the_true_scale_correlates_fully_and_another_does_not() -> None:
    scene = moebius(n_frames=3, n_points=40)
    result, _ = reconstruct(spheres(n_frames=3, n_points=40).tracks)
    edges = np.array([(0, 1), (0, 2)])
    scale = scene.conformal_scale(edges)
    right, wrong = (replace(result, edges=edges, conformal_scale=each) for each in (2.0 * scale, scale[:, ::-1]))
    assert accuracy.scale_correlation(right, scene) == pytest.approx(1.0)
    assert accuracy.scale_correlation(wrong, scene) < 0.9


def test_the_table_goes_between_the_comments(tmp_path: Path) -> None:
    readme = tmp_path / "README.md"
    readme.write_text(f"before\n{accuracy.MARKS[0]}\nold\n{accuracy.MARKS[1]}\nafter\n")
    accuracy.write_between_marks(readme, "new\n")
    assert readme.read_text() == f"before\n{accuracy.MARKS[0]}\nnew\n{accuracy.MARKS[1]}\nafter\n"
    readme.write_text("nothing\n")
    with pytest.raises(InputError, match="expected the comments"):
        accuracy.write_between_marks(readme, "new\n")


@pytest.mark.slow
def test_a_quick_run_is_kept_and_not_repeated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--quick", "--data", str(tmp_path), "--out", str(tmp_path)]
    assert accuracy.main(arguments) == 0
    assert "rows of tshirt.npz skipped" in capsys.readouterr().err
    rows = read_rows(tmp_path / "quick" / "accuracy.csv")
    assert [row["run"] for row in rows] == list(RUNS)
    assert accuracy.main(arguments) == 0
    assert read_rows(tmp_path / "quick" / "accuracy.csv") == rows
    with pytest.raises(SystemExit):
        accuracy.main(["no such row"])
