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
    difference = (dense.integrated(batch) - batch.log_depth)[batch.mask]
    assert np.std(difference) < 1e-3 * np.std(batch.log_depth[batch.mask])


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
