"""All baselines through the common interface."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from connrsfm_graph.baselines import BASELINES
from connrsfm_graph.cli.main import main
from connrsfm_graph.errors import InputError
from connrsfm_graph.methods import METHODS
from connrsfm_graph.metrics import evaluate
from connrsfm_graph.progress import Progress
from connrsfm_graph.reconstruct import Config
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.synthetic import isometric_bending, with_missing
from connrsfm_graph.tracks import load_tracks

NEED_SOLVER = ("mdh", "mlh")


def run(name: str, tracks):
    if name in NEED_SOLVER:
        pytest.importorskip("clarabel", reason="the extra 'baselines' is not installed")
    return METHODS[name](tracks, Config(), Progress())


@pytest.fixture(scope="module")
def tracks():
    return isometric_bending(n_frames=6, n_points=60, seed=2).tracks


# Not `diff`: it is no better than a plane on the real sets either.
@pytest.mark.parametrize("name", ["infp", "go20", "mdh", "mlh"])
def test_the_isometric_baselines_beat_a_fronto_parallel_plane(name: str, tracks) -> None:
    reconstruction, record = run(name, tracks)
    assert record.method == name
    flat = np.concatenate([tracks.normalised(), np.ones((*tracks.visible.shape, 1))], axis=-1)
    error = evaluate(reconstruction.points, tracks.points).e3d_percent
    assert error < 0.8 * evaluate(flat, tracks.points).e3d_percent


@pytest.mark.parametrize("name", BASELINES)
def test_missing_points_are_left_out_or_interpolated(name: str, tracks) -> None:
    missing = with_missing(tracks, 0.3, seed=0)
    reconstruction, _ = run(name, missing)
    assert not reconstruction.recovered[~missing.visible].any()
    assert reconstruction.recovered[missing.visible].mean() > 0.95
    assert (reconstruction.points[reconstruction.recovered][:, 2] > 0).all()


@pytest.mark.realdata
@pytest.mark.parametrize(
    ("name", "low", "high"),
    [("infp", 2.2, 2.8), ("diff", 3.5, 4.7), ("go20", 1.2, 2.4), ("mdh", 0.65, 0.95), ("mlh", 0.0, 0.60)],
)
def test_the_t_shirt_scores_as_published(name: str, low: float, high: float, realdata) -> None:
    tracks = load_tracks(realdata("tshirt.npz"))
    reconstruction, _ = run(name, tracks)
    assert low <= evaluate(reconstruction.points, tracks.points, tracks.visible).e3d_percent <= high


def test_a_baseline_runs_from_the_command_line(tmp_path: Path, tracks) -> None:
    source = tmp_path / "tracks.npz"
    np.savez(source, tracks=tracks.pixels, K=tracks.K, visible=tracks.visible)
    assert main(["reconstruct", str(source), "--out", str(tmp_path / "out"), "--method", "infp", "--no-report"]) == 0
    assert Reconstruction.load(tmp_path / "out").recovered.all()


def test_a_missing_solver_is_named_with_the_mend(monkeypatch: pytest.MonkeyPatch, tracks) -> None:
    def absent(name: str):
        raise ModuleNotFoundError("No module named 'clarabel'", name="clarabel")

    monkeypatch.setattr("connrsfm_graph.baselines.import_module", absent)
    with pytest.raises(InputError, match=r"'mdh' needs clarabel, .* install the extra 'baselines'"):
        BASELINES["mdh"](tracks, Config(), Progress())
