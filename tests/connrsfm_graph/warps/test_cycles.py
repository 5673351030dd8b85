"""Exact warps compose around triangles; one that does not is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from connrsfm_graph.synthetic import isometric_bending
from connrsfm_graph.warps import WarpConfig, fit_warps
from connrsfm_graph.warps.cycles import cycle_agreement

EDGES = np.array([(a, b) for a in range(5) for b in range(a + 1, 5)])


@pytest.fixture(scope="module")
def warps():
    scene = isometric_bending(n_frames=5, n_points=60)
    fitted = fit_warps(scene.image, scene.tracks.visible, EDGES, WarpConfig(model="gaussian_process"))
    return scene, fitted


def test_exact_jets_compose(warps):
    scene, fitted = warps
    agreement = cycle_agreement(replace(fitted, jets=scene.jets(EDGES)))
    assert len(agreement.triangles) == 10
    assert agreement.disagreement.max() < 1e-10


def test_fitted_warps_nearly_compose(warps):
    agreement = cycle_agreement(warps[1])
    assert np.isfinite(agreement.edge).all()
    assert np.median(agreement.edge) < 0.02


def test_a_wrong_warp_is_found(warps):
    jets = warps[1].jets
    J = jets.jacobian.copy()
    J[3] *= 1.5
    agreement = cycle_agreement(replace(warps[1], jets=replace(jets, jacobian=J)))
    assert list(agreement.suspects()) == [3]
    assert not len(cycle_agreement(warps[1]).suspects())


def test_trees_have_nothing_to_compare():
    scene = isometric_bending(n_frames=3, n_points=40)
    chain = np.array([(0, 1), (1, 2)])
    agreement = cycle_agreement(fit_warps(scene.image, scene.tracks.visible, chain))
    assert agreement.triangles.shape == (0, 3)
    assert np.isnan(agreement.edge).all()
    assert not len(agreement.suspects())
