"""The comparison of network and spline, in its quick form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from connrsfm_graph.dense.simulated import simulate
from experiments import dense
from experiments.study import Options, read_rows


def test_the_spline_integrates_exact_normals_to_the_surface() -> None:
    batch = simulate(2, dense.SIZE, (9, 1), (0.0, 0.0))
    for answer, truth, mask in zip(dense.integrated(batch), batch.log_depth, batch.mask, strict=True):
        difference = (answer - truth)[mask]
        assert np.abs(difference - difference.mean()).mean() < 1e-3


def test_the_quick_tables_hold_every_method_and_are_not_measured_twice(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="the extra 'dense' is not installed")
    options = Options(tmp_path, tmp_path, quick=True)
    dense.measure(options)
    rows = read_rows(tmp_path / "dense.csv")
    error = {(row["method"], row["condition"]): float(row["error_percent"]) for row in rows}
    assert error["network", "noise 0%"] < 1.0 < error["constant", "noise 0%"]
    assert error["spline", "noise 0%"] < 0.1
    assert {row["method"] for row in rows if row["table"] == "ablation"} == {
        "compact, noise in training",
        "compact, no noise in training",
    }
    dense.measure(options)
    assert read_rows(tmp_path / "dense.csv") == rows
    text = (tmp_path / "dense.md").read_text()
    assert text.count("| network |") == 1
