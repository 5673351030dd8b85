from __future__ import annotations

import csv
from pathlib import Path

import pytest

from experiments import slam
from experiments.benchmarks import growth


@pytest.mark.slow
def test_fusion_beats_its_parts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["--frames", "60", "--points", "60", "--background", "40", "--real-frames", "0", "--seed", "1"]
    assert slam.main(["--out", str(tmp_path / "new"), *arguments]) == 0
    assert "views aligned one by one" in capsys.readouterr().out
    with (tmp_path / "new" / "slam.csv").open() as file:
        rows = {row["method"]: row for row in csv.DictReader(file)}
    ate = {method: float(row["ate"]) for method, row in rows.items()}
    surface = {method: float(row["surface"]) for method, row in rows.items()}
    assert ate["fused"] < 0.5 * ate["odometry"]
    assert ate["fused, odometry only"] < 0.5 * ate["odometry"]
    assert surface["fused"] < surface["views aligned one by one"]
    assert surface["fused"] < surface["rigid"]
    assert ate["fused"] < ate["views chained one by one"]


def test_growth_is_measured(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert growth.main(["--out", str(tmp_path), "--frames", "60", "--points", "20"]) == 0
    printed = capsys.readouterr().out
    assert float(printed.split("in batch: ")[1].split(" %")[0]) < 0.1
    assert len((tmp_path / "growth.csv").read_text().splitlines()) == 61
