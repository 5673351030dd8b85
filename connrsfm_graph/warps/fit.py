"""Warps of all edges of an image graph, with their jets at the points and a report per edge."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.threads import mapped
from connrsfm_graph.warps.config import WarpConfig
from connrsfm_graph.warps.fitted import FittedWarp
from connrsfm_graph.warps.normalise import LocalCoordinates, jet_from_local
from connrsfm_graph.warps.select import Probe, fit_model, fit_process, is_resolved, resolve
from factors.warp_jet import JET_SIZE, WarpJet

# Points whose second principal spread is below this fraction of the first lie on a line.
_LINE = 1e-3
# A warp that leaves this fraction of the spread of the points unexplained is none.
_UNEXPLAINED = 0.5
# More than this fraction of the points with negative det J: the second image is a mirror image.
_MIRRORED = 0.5
# Up to this fraction nothing is said of them: at the border, or beside a wrong track, a smooth warp may well fold.
_BORDER = 0.03


@dataclass(frozen=True)
class WarpReport:
    """What is known about the warp of one edge."""

    n_points: int
    """Points visible in both images."""
    model: str
    """Model fitted; empty where none was."""
    residual: float = np.nan
    """Root mean square of a coordinate of the residuals, normalised image coordinates of image b."""
    folded: int = 0
    """Shared points where det J <= 0."""
    settings: Mapping[str, float] = field(default_factory=dict)
    """Smoothing weights or hyper-parameters, in local coordinates of unit spread."""
    usable: bool = False
    """Whether the edge takes part in the reconstruction."""
    problem: str | None = None
    """What is wrong with the edge, one sentence."""


@dataclass(frozen=True)
class Warps:
    """Warps of E edges at P points, in normalised image coordinates."""

    edges: np.ndarray
    """(E, 2) int, images a and b; the warp maps image a to image b."""
    jets: WarpJet
    """Leading dimensions (E, P). Where `valid` is false and the point is not shared or the edge has no warp: value 0,
    J the identity, all else 0."""
    valid: np.ndarray
    """(E, P) bool: visible in both images, the edge is usable and the warp not folded there (det J > 0)."""
    weight: np.ndarray
    """(E, P) robust weight in [0, 1], 0 where there is no warp: far below 1 for tracks the others contradict."""
    noise: np.ndarray
    """(E,) standard deviation of a coordinate of the points of image b about the Gaussian-process warp, whichever model
    gives the jets, normalised coordinates; it holds the noise of both images. NaN where there is no warp."""
    residual: np.ndarray
    """(E,) root mean square of a coordinate of the residuals, normalised coordinates; NaN where there is no warp."""
    reports: tuple[WarpReport, ...]
    """One per edge."""
    config: WarpConfig
    """The configuration used, with model and weights as chosen."""


def fit_warps(
    image: np.ndarray,
    visible: np.ndarray,
    edges: np.ndarray,
    config: WarpConfig | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Warps:
    """Fit the warp of every edge to the points visible in both of its images.

    Bad edges (too few points, points on a line, mirrored or folded warps) are reported, not raised.

    Args:
        image: (F, P, 2) normalised image coordinates; entries not visible are ignored and may be NaN.
        visible: (F, P) bool.
        edges: (E, 2) int, images a and b.
        config: how to fit; defaults to `WarpConfig()`.
        progress: called with (edges done, edges) after every edge.

    Raises:
        InputError: shapes that do not fit together, an edge between images that do not exist, or a visible point
            without a finite position.
    """
    config = config or WarpConfig()
    image, visible, edges = _checked(image, visible, edges)
    E, P = len(edges), image.shape[1]
    jets = WarpJet(
        value=np.zeros((E, P, 2)),
        jacobian=np.tile(np.eye(2), (E, P, 1, 1)),
        hessian=np.zeros((E, P, 2, 3)),
        covariance=np.zeros((E, P, JET_SIZE, JET_SIZE)) if config.covariance else None,
    )
    valid, weight = np.zeros((E, P), dtype=bool), np.zeros((E, P))
    noise, residual = np.full(E, np.nan), np.full(E, np.nan)
    reports = []
    if not is_resolved(config):
        config = resolve(config, _probes(image, visible, edges, config))

    def fitted(edge: np.ndarray) -> tuple[np.ndarray, _Fitted | str]:
        a, b = edge
        shared = np.flatnonzero(visible[a] & visible[b])
        return shared, _problem(image[a, shared], image[b, shared], config) or _fit(image[:, shared], edge, config)

    for e, (shared, found) in enumerate(mapped(fitted, edges)):
        if isinstance(found, str):
            reports.append(WarpReport(len(shared), "", problem=found))
        else:
            reports.append(found.report)
            noise[e], residual[e] = found.noise, found.report.residual
            weight[e, shared] = found.weight
            valid[e, shared] = found.report.usable & ~found.folded
            jets.value[e, shared], jets.jacobian[e, shared] = found.jet.value, found.jet.jacobian
            jets.hessian[e, shared] = found.jet.hessian
            if jets.covariance is not None and found.jet.covariance is not None:
                jets.covariance[e, shared] = found.jet.covariance
        if progress is not None:
            progress(e + 1, E)
    return Warps(edges, jets, valid, weight, noise, residual, tuple(reports), config)


@dataclass(frozen=True)
class _Fitted:
    """The warp of one edge at its shared points, normalised image coordinates."""

    report: WarpReport
    jet: WarpJet
    weight: np.ndarray
    folded: np.ndarray
    noise: float


def _fit(image: np.ndarray, edge: np.ndarray, config: WarpConfig) -> _Fitted:
    """The warp between two images of the points that both see, (F, N, 2)."""
    a, b = edge
    local_a, local_b = LocalCoordinates.of(image[a]), LocalCoordinates.of(image[b])
    probe = _probe(image[a], image[b], config)
    points, _, process = probe
    warp = fit_model(config, probe)
    jet = jet_from_local(warp.jet(points, config.covariance), local_a, local_b)
    folded = np.linalg.det(jet.jacobian) <= 0.0
    return _Fitted(_report(warp, folded, local_b.spread), jet, warp.weight, folded, process.noise * local_b.spread)


def _checked(image: np.ndarray, visible: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    image, visible, edges = np.asarray(image, dtype=float), np.asarray(visible), np.asarray(edges)
    if image.ndim != 3 or image.shape[2] != 2:
        raise InputError(f"image points have shape {image.shape}, expected (frames, points, 2)")
    if visible.shape != image.shape[:2] or visible.dtype != bool:
        raise InputError(f"'visible' is {visible.dtype} {visible.shape}, expected bool {image.shape[:2]}")
    if edges.ndim != 2 or edges.shape[1] != 2 or edges.dtype.kind not in "iu":
        raise InputError(f"edges are {edges.dtype} {edges.shape}, expected integers of shape (edges, 2)")
    if edges.size and (edges.min() < 0 or edges.max() >= len(image) or (edges[:, 0] == edges[:, 1]).any()):
        raise InputError(f"edges must join two different images among 0 to {len(image) - 1}")
    bad = np.argwhere(visible & ~np.isfinite(image).all(axis=-1))
    if len(bad):
        raise InputError(f"point {bad[0, 1]} is visible in frame {bad[0, 0]} but has no finite position there")
    return image, visible, edges


def _problem(points: np.ndarray, target: np.ndarray, config: WarpConfig) -> str | None:
    """Why no warp can be fitted to these points, or None."""
    if len(points) < config.min_points:
        return f"only {len(points)} shared points, a warp needs {config.min_points}"
    for side, coordinates in (("first", points), ("second", target)):
        spreads = np.linalg.svd(coordinates - coordinates.mean(axis=0), compute_uv=False)
        if spreads[1] <= _LINE * spreads[0]:
            return f"the shared points lie on a line in the {side} image"
    return None


def _report(warp: FittedWarp, folded: np.ndarray, spread: float) -> WarpReport:
    n, count = len(folded), int(folded.sum())
    rms = float(np.sqrt((warp.weight[:, None] * warp.residual**2).sum() / (2.0 * warp.weight.sum())))
    problem, usable = None, True
    if count > _MIRRORED * n:
        problem, usable = f"the second image mirrors the first (det J <= 0 at {count} of {n} points)", False
    elif warp.noise > _UNEXPLAINED:
        problem, usable = f"no smooth warp explains the points (noise is {warp.noise:.0%} of their spread)", False
    elif count > _BORDER * n:
        problem = f"the warp is folded (det J <= 0) at {count} of {n} points, which are left out"
    return WarpReport(n, warp.model, rms * spread, count, dict(warp.settings), usable, problem)


def _probes(image: np.ndarray, visible: np.ndarray, edges: np.ndarray, config: WarpConfig) -> list[Probe]:
    """Points and targets, in local coordinates, of up to `probe_edges` fit edges spread evenly over the list."""
    fit = []
    for a, b in edges:
        shared = visible[a] & visible[b]
        if _problem(image[a, shared], image[b, shared], config) is None:
            fit.append((image[a, shared], image[b, shared]))
    chosen = np.unique(np.linspace(0, len(fit) - 1, min(config.probe_edges, len(fit))).round().astype(int))
    return [_probe(fit[i][0], fit[i][1], config) for i in chosen]


def _probe(points: np.ndarray, target: np.ndarray, config: WarpConfig) -> Probe:
    local, local_target = LocalCoordinates.of(points).to_local(points), LocalCoordinates.of(target).to_local(target)
    return local, local_target, fit_process(config, local, local_target)
