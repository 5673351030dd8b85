"""Scenes of many kinds."""

from __future__ import annotations

import numpy as np
import pytest

from connrsfm_graph.errors import InputError
from connrsfm_graph.synthetic import varied
from connrsfm_graph.synthetic.jet import Jet
from connrsfm_graph.synthetic.variety import KINDS


def metrics(kind: str, seed: int) -> np.ndarray:
    """(images, 3, P) first fundamental forms of a kind's surfaces over the sheet."""
    rng = np.random.default_rng(seed)
    surface = KINDS[kind](rng)
    s, t = Jet.variables(*(rng.uniform(-1.0, 1.0, (2, 50)) * [[1.0], [0.75]]))
    forms = []
    for motion in ([0.9, 0.4], [-0.7, -0.8], [0.1, 0.0]):
        along_s, along_t = surface(s, t, np.array(motion)).gradient
        forms.append([(along_s**2).sum(axis=0), (along_s * along_t).sum(axis=0), (along_t**2).sum(axis=0)])
    return np.array(forms)


@pytest.mark.parametrize("kind", ["roll", "waves", "cone", "plane", "torn", "folded"])
@pytest.mark.parametrize("seed", range(4))
def test_paper_keeps_its_lengths(kind: str, seed: int) -> None:
    sheet = np.broadcast_to(np.array([1.0, 0.0, 1.0])[:, None], (3, 50))
    for form in metrics(kind, seed):
        np.testing.assert_allclose(form, sheet, atol=1e-7)


@pytest.mark.parametrize("kind", ["cloth", "tissue", "balloon", "face"])
def test_what_stretches_does_so_a_little(kind: str) -> None:
    stretch = [np.ptp(metrics(kind, seed), axis=0).max() for seed in range(4)]
    assert min(stretch) > 1e-3
    assert max(stretch) < 0.8


def test_rubber_is_pulled_as_a_whole() -> None:
    for seed in range(4):
        forms = metrics("rubber", seed)
        np.testing.assert_allclose(forms, forms[..., :1].repeat(50, axis=-1), atol=1e-7)
        assert np.ptp(forms[..., 0], axis=0).max() > 0.05


def test_the_flaps_of_a_torn_sheet_part() -> None:
    """Of neighbours only the few across the cut come apart."""
    openings = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        surface = KINDS["torn"](rng)
        s, t = Jet.variables(*(rng.uniform(-1.0, 1.0, (2, 400)) * [[1.0], [0.75]]))
        closed, opened = (surface(s, t, np.array([0.0, motion])).value for motion in (-1.0, 1.0))
        before, after = (np.linalg.norm(X[:, :, None] - X[:, None], axis=0) for X in (closed, opened))
        near = np.triu(before < 0.1, 1)
        ratio = after[near] / before[near]
        assert ratio.min() > 0.99
        assert (ratio > 1.05).mean() < 0.05
        openings.append(ratio.max())
    assert np.median(openings) > 2.0


def test_what_is_rigid_only_moves() -> None:
    form = metrics("rigid", 0)
    np.testing.assert_allclose(form, form[:1].repeat(3, axis=0), atol=1e-12)
    assert np.ptp(form[0]) > 1e-3


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_makes_tracks_with_truth(kind: str) -> None:
    tracks = [varied(kind, seed) for seed in range(3)]
    assert len({each.pixels.shape for each in tracks}) == 3
    for each in tracks:
        assert each.points is not None
        assert (each.points[..., 2] > 0).all()
        image = each.points[..., :2] / each.points[..., 2:] * each.focal_length()
        error = (each.pixels - image - [319.5, 239.5])[each.visible]
        assert 0.25 < error.std() < 3.3
    again = varied(kind, 0)
    np.testing.assert_array_equal(again.pixels, tracks[0].pixels)


def test_there_is_no_other_kind() -> None:
    with pytest.raises(InputError, match="there is no kind of scene 'origami', expected one of roll"):
        varied("origami")
