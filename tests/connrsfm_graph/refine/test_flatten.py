"""Meshes laid out in the plane."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from connrsfm_graph.refine.flatten import flattened
from connrsfm_graph.refine.mesh import Mesh, surface_mesh
from connrsfm_graph.refine.start import log_chords
from connrsfm_graph.synthetic.placing import flat_sheet, rolled


def roll(seed: int) -> tuple[Mesh, np.ndarray, np.ndarray]:
    """The mesh of a sheet of paper as seen obliquely, the lengths on the flat sheet, and the sheet (P, 2)."""
    s, t = flat_sheet(80, np.random.default_rng(seed))
    sheet = np.stack([s.value, t.value], axis=1)
    x, y, z = rolled((s, t), 0.8, 0.3).value
    seen = np.stack([x, 0.6 * y + 0.4 * z], axis=1)
    mesh = surface_mesh(seen, lambda edges: log_chords(sheet[None], edges)[0])
    return mesh, log_chords(sheet[None], mesh.edges)[0], sheet


@pytest.mark.parametrize("seed", range(3))
def test_a_developable_surface_is_laid_out_with_its_lengths(seed: int) -> None:
    mesh, log_length, sheet = roll(seed)
    flat = flattened(mesh, log_length)
    off = [np.abs(log_chords(each.position[None], mesh.edges)[0] - log_length) for each in (mesh, flat)]
    assert np.median(off[0]) > 0.05
    assert np.median(off[1]) < 0.002
    # Directions are those on the sheet, but for one turn of it all.
    true = flat.direction @ [1, 1j]
    d = sheet[mesh.edges[:, 1]] - sheet[mesh.edges[:, 0]]
    turn = true / np.exp(2j * np.arctan2(d[:, 1], d[:, 0]))
    assert np.quantile(np.abs(turn / turn.mean() - 1.0), 0.9) < 0.05


def test_a_point_that_hangs_together_with_nothing_stays_and_moves_no_other() -> None:
    mesh, log_length, _ = roll(0)
    alone = flattened(mesh, log_length).position
    apart = flattened(replace(mesh, position=np.concatenate([mesh.position, [[5.0, 5.0]]])), log_length).position
    np.testing.assert_allclose(apart[:-1], alone, atol=1e-6)
    assert apart[-1, 0] == pytest.approx(apart[-1, 1])
    assert 2.0 < apart[-1, 0] < 10.0
