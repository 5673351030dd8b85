"""Views that are pulled as a whole: found out, told from isometric ones and from those that stretch otherwise."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from connrsfm_graph.config import override
from connrsfm_graph.metrics import evaluate
from connrsfm_graph.reconstruct import default_config, reconstruct
from connrsfm_graph.refine import RefineConfig
from connrsfm_graph.refine.flatten import flattened
from connrsfm_graph.refine.mesh import Mesh
from connrsfm_graph.refine.noise import Noise
from connrsfm_graph.refine.start import start_shape
from connrsfm_graph.refine.strain import stretched
from connrsfm_graph.refine.task import Fit, Task, minimised
from connrsfm_graph.refine.unseen import complete
from connrsfm_graph.synthetic import varied, with_noise
from connrsfm_graph.synthetic.jet import Jet
from connrsfm_graph.synthetic.placing import facing_draws, flat_sheet, placed, rolled, smooth_motion
from connrsfm_graph.synthetic.scene import Scene
from connrsfm_graph.tracks import Tracks

PULLS = np.array([0.0, 0.1, 0.2, 0.3, 0.15, 0.05, 0.25, 0.0])


def rubber(pulls: np.ndarray = PULLS, n_points: int = 100, noise: float = 0.5, seed: int = 0) -> Tracks:
    """A roll that moves smoothly; in every image pulled along the sheet's width, and narrower by as much."""
    rng = np.random.default_rng(seed)
    s, t = flat_sheet(n_points, rng)

    def draw() -> list[Jet]:
        motion = smooth_motion(len(pulls), 8, rng)
        pulled = [(s * np.exp(pull), t * np.exp(-pull)) for pull in pulls]
        rolls = [rolled(sheet, m[0], np.pi * m[1]) for sheet, m in zip(pulled, motion, strict=True)]
        return [placed(roll, m[2:], 25.0, (0.75, 1.0)) for roll, m in zip(rolls, motion, strict=True)]

    return with_noise(Scene.of(facing_draws(draw)).tracks, noise, seed)


def error(tracks: Tracks, *settings: str) -> tuple[float, dict]:
    result, record = reconstruct(tracks, override(default_config(), list(settings)))
    assert np.isfinite(result.depth_std[tracks.visible]).all()
    return evaluate(result.points, tracks.points, tracks.visible).e3d_percent, record.decisions["refinement"]


@pytest.mark.parametrize("seed", [1, 3])
def test_pulls_are_found_and_told_from_tilts(seed: int) -> None:
    tracks = rubber(seed=seed)
    found, evidence = error(tracks)
    assert evidence["isometric over stretched cost"] > 2.0
    assert evidence["part by which strains lower squared errors of points left out"] > 0.3
    assert found < 0.5
    # Differences between the views tell, what is common to all belongs to the lengths; the axis is that of the mesh.
    strain = np.array(evidence["strain of views"])
    sizes, pulls = strain - strain.mean(axis=0), PULLS - PULLS.mean()
    along = sizes @ np.linalg.svd(sizes)[2][0]
    assert along * np.sign(along @ pulls) == pytest.approx(pulls, abs=0.03)
    without, _ = error(tracks, "refine.stretched=no")
    assert without > 3.0 * found


@pytest.mark.parametrize(
    ("parts", "points", "searches", "taken"),
    [
        ((0.2, 0.2), 500, 1, True),
        ((0.12, 0.2), 500, 1, True),
        ((0.2, 0.2), 6, 1, False),
        ((0.2, 0.1), 500, 1, False),
        ((0.08, 0.2), 500, 0, False),
        ((-0.2, 0.2), 500, 0, False),
    ],
)
def test_strains_are_taken_where_they_predict_points_left_out_far_better(
    monkeypatch: pytest.MonkeyPatch, parts: tuple[float, float], points: int, searches: int, taken: bool
) -> None:
    """And surely so, whatever they gain in cost; they are searched for where already a first fit does it better."""
    errors, of_fits = np.random.default_rng(0).chisquare(2, points), iter(parts)
    searched = []

    def canned(fits: Iterable[Fit], seen: np.ndarray) -> list[np.ndarray]:
        part = next(of_fits)
        return [errors * (1.0 - part if fit.shape.strain.size else 1.0) for fit in fits]

    def one_search(mesh: Mesh, log_length: np.ndarray) -> tuple[Mesh, np.ndarray]:
        searched.append(mesh)
        return flattened(mesh, log_length)

    monkeypatch.setattr("connrsfm_graph.refine.strain.errors_of", canned)
    monkeypatch.setattr("connrsfm_graph.refine.strain._ROUNDS", 1)
    monkeypatch.setattr("connrsfm_graph.refine.strain.flattened", one_search)
    tracks = rubber(n_points=40, seed=1)
    task = Task.of(
        complete(tracks.normalised(), tracks.visible, np.log(tracks.points[..., 2])), tracks.visible, RefineConfig()
    )
    noise = Noise.start(0.5 / tracks.focal_length(), 0.01, task.spacing())
    measurements = task.measurements(noise, conformal=False)
    shape, history = minimised(task, measurements, start_shape(task.completed, task.mesh))
    _, found = stretched(task, Fit(measurements, shape, noise, history, history[-1], noisy=False), noise)
    assert bool(found.shape.strain.size) == taken
    assert len(searched) == searches
    assert found.evidence["part by which strains lower squared errors of points left out"] == pytest.approx(
        parts[searches], abs=0.02
    )


def test_exact_pulls_are_found() -> None:
    found, evidence = error(rubber(noise=0.0, seed=1))
    assert evidence["isometric over stretched cost"] > 100.0
    assert found < 0.05


def test_views_that_follow_are_pulled_too() -> None:
    tracks = rubber(np.tile(PULLS, 2), seed=1)
    found, evidence = error(tracks, "keyframes.most=8")
    assert len(evidence["strain of views"]) == 8
    assert found < 2.0 * error(tracks)[0] + 0.1


@pytest.mark.parametrize("kind", ["cloth", "tissue", "balloon", "waves"])
def test_what_is_not_pulled_is_not_taken_for_pulled(kind: str) -> None:
    _, evidence = error(varied(kind, 62))
    assert "strain of views" not in evidence


def test_what_is_hardly_pulled_is_so_only_if_asked_for() -> None:
    tracks = rubber(0.03 * PULLS, seed=1)
    found, evidence = error(tracks)
    assert "strain of views" not in evidence
    asked, evidence = error(tracks, "refine.stretched=yes")
    assert np.hypot(*np.array(evidence["strain of views"]).T).max() < 0.1
    assert max(found, asked) < 1.0
