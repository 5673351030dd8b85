"""A pipeline that answers at once, so that these tests are about the command line alone."""

from __future__ import annotations

import sys
import types
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from connrsfm_graph.cli.main import main
from connrsfm_graph.config import as_dict
from connrsfm_graph.image_graph import GraphConfig, select_edges
from connrsfm_graph.progress import Progress
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.run_record import RunRecord
from connrsfm_graph.tracks import Tracks


@dataclass(frozen=True)
class Stage:
    iterations: int = 10
    """How often."""


@dataclass(frozen=True)
class Config:
    seed: int = 0
    solve: Stage = field(default_factory=Stage)


def answer(
    tracks: Tracks, config: Config, progress: Progress, checkpoints: Any = None
) -> tuple[Reconstruction, RunRecord]:
    """Every surface is a gentle bowl; shaped and valued as a true result would be."""
    F, P = tracks.visible.shape
    image = tracks.normalised()
    graph = select_edges(tracks.visible, GraphConfig(), image)
    depth = 1.0 + 0.3 * (image**2).sum(axis=-1)
    points = np.concatenate([image * depth[..., None], depth[..., None]], axis=-1)
    with progress.stage("solve"):
        reconstruction = Reconstruction(
            pixels=tracks.pixels,
            K=tracks.K,
            visible=tracks.visible,
            points=points,
            normals=np.tile([0.0, 0.0, -1.0], (F, P, 1)),
            depth=depth,
            first_order=np.zeros((F, P, 2)),
            second_order=np.zeros((F, P, 3)),
            edges=graph.edges,
            edge_weight=graph.weight,
            conformal_scale=np.ones((len(graph.edges), P)),
            depth_std=np.full((F, P), np.nan),
            log_factor=np.zeros((F, P)),
            interpolated=np.zeros((F, P), bool),
            outlier=np.zeros((F, P), bool),
            camera=tracks.camera,
        )
    record = RunRecord(
        source="",
        method="",
        seed=config.seed,
        configuration=as_dict(config),
        cost_history={"solve": [3.0, 2.0, 1.0]},
        seconds=progress.seconds,
    )
    return reconstruction, record


def fail(tracks: Tracks, config: Config, progress: Progress) -> Any:
    raise ZeroDivisionError("by nothing")


def interrupt(tracks: Tracks, config: Config, progress: Progress) -> Any:
    raise KeyboardInterrupt


@pytest.fixture(autouse=True)
def pipeline(monkeypatch: pytest.MonkeyPatch) -> None:
    """Stands in for `connrsfm_graph.reconstruct`."""
    module: Any = types.ModuleType("connrsfm_graph.reconstruct")
    module.Config = Config
    module.default_config = lambda mode: Config(solve=Stage(iterations=10 if mode == "default" else 1))
    monkeypatch.setitem(sys.modules, "connrsfm_graph.reconstruct", module)
    methods: Any = types.ModuleType("connrsfm_graph.methods")
    methods.METHODS = {"connrsfm": answer, "fail": fail, "interrupt": interrupt}
    monkeypatch.setitem(sys.modules, "connrsfm_graph.methods", methods)


@dataclass(frozen=True)
class Ended:
    status: int
    out: str
    err: str


@pytest.fixture
def connrsfm(capsys: pytest.CaptureFixture[str]) -> Callable[..., Ended]:
    """Run the command line in this process."""

    def run(*arguments: object) -> Ended:
        status = main([str(argument) for argument in arguments])
        captured = capsys.readouterr()
        return Ended(status, captured.out, captured.err)

    return run


def arrays(F: int = 4, P: int = 12) -> dict[str, np.ndarray]:
    """Fields of a tracks file: a bent sheet seen from changing places, with its truth."""
    rng = np.random.default_rng(0)
    sheet = rng.uniform(-1, 1, (P, 2))
    points = np.stack([np.column_stack([sheet, 5 + 0.3 * f * sheet[:, 0] ** 2]) for f in range(F)])
    K = np.array([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    seen = points @ K.T
    return {
        "tracks": seen[..., :2] / seen[..., 2:],
        "K": K,
        "visible": np.ones((F, P), bool),
        "points": points,
    }


@pytest.fixture
def tracks_file(tmp_path: Path) -> Path:
    path = tmp_path / "tracks.npz"
    np.savez(path, **arrays())  # type: ignore[arg-type]
    return path
