from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from connrsfm_graph.synthetic import spheres
from experiments import theorem


def test_second_order_terms_make_the_theorem_exact() -> None:
    index = theorem.verify(n_pairs=10, n_points=100)
    assert index.shape == (10, 100, 2)
    assert index[..., 1].max() < 1e-10
    assert index[..., 0].mean(axis=1).min() > 10.0
    assert index[..., 0].max() <= 100.0


def test_the_index_sees_a_wrong_second_order_term() -> None:
    scene = spheres(n_frames=2, seed=4)
    wrong = scene.second_order.copy()
    wrong[0, :, 1] += 0.1
    assert theorem.index_percent(scene, wrong).min() > 0.05


def test_the_transported_connection_follows_the_theorem() -> None:
    """B computed from its definition at one point equals A there: the index does not compare a quantity with itself."""
    from factors.surface import connections

    scene, point = spheres(n_frames=2, seed=2), 7
    jet = scene.jets(theorem.EDGE)
    J, hessian = jet.jacobian[0, point], jet.hessian[0, point]
    rho = np.exp(np.log(scene.conformal_scale(theorem.EDGE)[0]) + scene.log_depth[1] - scene.log_depth[0])[point]
    gamma = connections(scene.image, scene.first_order, scene.second_order)[:, point]
    J3 = np.diag([0.0, 0.0, np.linalg.det(J)])
    J3[:2, :2] = J
    scale = np.diag([rho, rho, rho**2])
    for k in range(2):
        dJ = hessian[:, k : k + 2]
        dJ3 = np.diag([0.0, 0.0, np.linalg.det(J) * np.trace(np.linalg.inv(J) @ dJ)])
        dJ3[:2, :2] = dJ
        carried = (gamma[1, 0] * J[0, k] + gamma[1, 1] * J[1, k]) @ J3 + dJ3
        np.testing.assert_allclose(J3 @ scale @ gamma[0, k] @ np.linalg.inv(scale), carried, atol=1e-11)


def test_the_script_writes_table_and_plot(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("matplotlib")
    assert theorem.main(["--out", str(tmp_path / "new"), "--pairs", "2", "--points", "20"]) == 0
    assert "first and second order" in capsys.readouterr().out
    with (tmp_path / "new" / "theorem.csv").open() as file:
        rows = list(csv.reader(file))
    assert len(rows) == 1 + 2 * 20
    assert max(float(row[3]) for row in rows[1:]) < 1e-10
    assert (tmp_path / "new" / "theorem.png").stat().st_size > 10_000
    assert theorem.table(theorem.verify(2, 20)) in (tmp_path / "new" / "theorem.md").read_text()
