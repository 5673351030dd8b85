"""The main job: tracks and a configuration in, a reconstruction and its record out, stage by stage.

    tracks -> image graph -> warps -> problem -> pre-step -> solve and integrate -> refine -> surfaces

Every stage is a function of frozen data and can be called alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from threadpoolctl import threadpool_limits

from connrsfm_graph.config import as_dict
from connrsfm_graph.errors import ComputationError
from connrsfm_graph.image_graph import GraphConfig, ImageGraph, select_edges
from connrsfm_graph.initialise import Start, initialise, with_closed_form_scale
from connrsfm_graph.integrate import IntegrationConfig, terms_of_depth
from connrsfm_graph.problem import Problem, State, make_problem
from connrsfm_graph.progress import Progress
from connrsfm_graph.reconstruction import Reconstruction, RunRecord, package_versions, peak_memory_mib
from connrsfm_graph.refine import RefineConfig, Refined, refine
from connrsfm_graph.solvers.batched import BatchedBackend
from connrsfm_graph.solvers.gtsam_backend import GtsamBackend
from connrsfm_graph.solvers.interface import Backend
from connrsfm_graph.solvers.separable import SolveConfig, Solved, solve
from connrsfm_graph.tracks import Tracks
from connrsfm_graph.warps import WarpConfig, Warps, estimate_pixel_noise, fit_warps
from connrsfm_graph.warps.cycles import cycle_agreement
from factors.noise import PairNoise
from factors.surface import PERSPECTIVE, normals

NOISY = 0.05
"""Misfit of the warps, relative to the points' spread, from which the user is warned."""
METRIC_ONLY = PairNoise(intrinsic=math.inf, extrinsic=math.inf)
"""For the scale of a finished surface: only the metric rows hold for every conformal map."""


@dataclass(frozen=True)
class Config:
    """Settings of every stage."""

    graph: GraphConfig = field(default_factory=GraphConfig)
    """Which pairs of images are used."""
    warps: WarpConfig = field(default_factory=WarpConfig)
    """Image warps."""
    start: Start = "pre-step"
    """First-order terms at the start of the differential solve: the isometric pre-step's or, for ablations, all zero,
    all one or random."""
    solve: SolveConfig = field(default_factory=SolveConfig)
    """Differential solve."""
    integrate: IntegrationConfig = field(default_factory=IntegrationConfig)
    """From first-order terms to depth."""
    refine: RefineConfig = field(default_factory=RefineConfig)
    """Global refinement over shared edge lengths."""
    refinement: bool = True
    """Whether to refine."""
    seed: int = 0
    """Seed of every random choice."""


def default_config(mode: Literal["default", "paper"] = "default") -> Config:
    """The best known settings, or the published algorithm as written."""
    if mode == "default":
        return Config()
    return Config(warps=WarpConfig(model="schwarzian"), solve=SolveConfig(schedule="separable"), refinement=False)


@threadpool_limits.wrap(limits=1, user_api="blas")
def reconstruct(
    tracks: Tracks, config: Config | None = None, progress: Progress | None = None
) -> tuple[Reconstruction, RunRecord]:
    """Reconstruct the surface of every image.

    The dense systems are small and many: threads run over points and images in compiled code, BLAS is held to one.

    Args:
        tracks: checked tracks (see `tracks.check_reconstructable` for what makes them reconstructable).
        config: settings; the defaults where None.
        progress: times and shows the stages.

    Raises:
        InputError: the tracks cannot be used (for example, groups of images share no tracks).
        ComputationError: a stage failed.
    """
    config = config or Config()
    progress = progress or Progress()
    image, visible = tracks.normalised(), tracks.visible
    with progress.stage("image graph"):
        graph = select_edges(visible, config.graph, image)
    with progress.stage("warps"):
        warps = fit_warps(image, visible, graph.edges, config.warps, progress.update)
    problem = make_problem(image, visible, graph.edges, warps.jets, warps.weight * warps.valid)
    _refuse_unrelated(problem, warps)
    backend = make_backend(config.solve.backend)
    with progress.stage("pre-step"):
        start = initialise(problem, backend, config.solve.levenberg, config.start, config.seed)
    with progress.stage("solve"):
        solved = solve(problem, start, backend, config.solve, config.integrate, progress.update)
    refined = None
    if config.refinement:
        with progress.stage("noise level"):
            sigma = estimate_pixel_noise(image, visible, graph.edges)
        with progress.stage("refinement"):
            log_depth = np.where(visible, solved.state.log_depth.T, np.nan)
            refined = refine(image, visible, log_depth, config.refine, sigma, progress.update)
    with progress.stage("surfaces"):
        result = _surfaces(tracks, graph, problem, solved, refined)
    return result, _record(tracks, config, graph, warps, problem, solved, refined, progress)


def make_backend(name: str) -> Backend:
    """The solver of the point-wise problem by name."""
    return GtsamBackend() if name == "gtsam" else BatchedBackend()


def _refuse_unrelated(problem: Problem, warps: Warps) -> None:
    """Say why an image has no usable warp, before integration finds nothing there."""
    for frame in np.flatnonzero(problem.constrained().sum(axis=0) < 3):
        mine = np.flatnonzero((warps.edges == frame).any(axis=1))
        reasons = [warps.reports[e].problem for e in mine if warps.reports[e].problem]
        raise ComputationError(
            f"image {frame} cannot be related to any other: {reasons[0] if reasons else 'no warp is usable'}; "
            "check its tracks for gross errors, or leave it out"
        )


def _surfaces(
    tracks: Tracks, graph: ImageGraph, problem: Problem, solved: Solved, refined: Refined | None
) -> Reconstruction:
    """Gather the last stage's surfaces; terms and scales always belong to the points that are returned."""
    visible = tracks.visible
    if refined is None:
        image, state = np.moveaxis(problem.image, 0, 1), solved.state
        log_depth = state.log_depth.T
        points = PERSPECTIVE.points(image, np.exp(log_depth))
        first, second = np.moveaxis(state.first_order, 0, 1), np.moveaxis(state.second_order, 0, 1)
        recovered, depth_std = visible, np.full(visible.shape, np.nan)
        log_factor, outlier = np.full(visible.shape, np.nan), np.zeros(visible.shape, dtype=bool)
        # Points without a usable pair lie on the surface through the others.
        bare = ~problem.constrained().T
        first = np.where(bare[..., None], np.moveaxis(solved.integrated.first_order, 0, 1), first)
        second = np.where(bare[..., None], np.moveaxis(solved.integrated.second_order, 0, 1), second)
    else:
        points, log_depth = refined.points, refined.log_depth
        recovered = np.isfinite(points).all(axis=-1)
        if not (points[recovered][:, 2] > 0).all():
            raise ComputationError("the refinement left points without depth; check the tracks for gross errors")
        image = np.where(recovered[..., None], points[..., :2] / points[..., 2:], 0.0)
        first, second = terms_of_depth(image, log_depth, recovered, problem.camera)
        depth_std, log_factor, outlier = refined.depth_std, refined.log_factor, refined.outlier
    if not recovered.any() or not np.isfinite(points[recovered]).all():
        raise ComputationError("the reconstruction holds no finite surface; check the tracks for gross errors")
    frame = np.concatenate([first, second, np.where(recovered, log_depth, 0.0)[..., None]], axis=-1)
    scaled = with_closed_form_scale(
        problem, State(np.ascontiguousarray(frame.transpose(1, 0, 2)), solved.state.log_scale), METRIC_ONLY
    )
    seen = recovered[..., None]
    return Reconstruction(
        pixels=tracks.pixels,
        K=tracks.K,
        visible=visible,
        points=np.where(seen, points, np.nan),
        normals=np.where(seen, normals(image, first), np.nan),
        depth=np.where(recovered, points[..., 2], np.nan),
        first_order=np.where(seen, first, np.nan),
        second_order=np.where(seen, second, np.nan),
        edges=graph.edges,
        edge_weight=graph.weight,
        conformal_scale=np.where(problem.weight > 0, np.exp(scaled.log_scale), np.nan).T,
        depth_std=np.where(recovered, depth_std, np.nan),
        log_factor=log_factor,
        interpolated=recovered & ~(problem.constrained().T & visible),
        outlier=outlier,
        image_names=None if tracks.image_names is None else np.asarray(tracks.image_names),
        ambiguous=None if refined is None or refined.alternative is None else refined.ambiguous,
        alternative=None if refined is None else refined.alternative,
    )


def _record(
    tracks: Tracks,
    config: Config,
    graph: ImageGraph,
    warps: Warps,
    problem: Problem,
    solved: Solved,
    refined: Refined | None,
    progress: Progress,
) -> RunRecord:
    reports = zip(warps.edges, warps.reports, strict=True)
    problems = [(edge, report.problem) for edge, report in reports if report.problem]
    warnings = [f"warp from image {a} to image {b}: {problem}" for (a, b), problem in problems[:5]]
    if len(problems) > 5:
        warnings.append(f"{len(problems) - 5} more warps had problems")
    cycles = cycle_agreement(warps)
    suspects = cycles.suspects()
    if len(suspects):
        pairs = ", ".join(f"{a}-{b}" for a, b in warps.edges[suspects[:5]])
        warnings.append(f"{len(suspects)} warps disagree with the others around cycles of the image graph ({pairs})")
    spread = float(np.nanmedian(np.nanstd(tracks.pixels, axis=1)))
    if (misfit := (_median(warps.residual) or 0.0) * tracks.focal_length()) > NOISY * spread:
        warnings.append(
            f"the tracks are very noisy or no smooth surface: warps miss by {misfit:.3g} pixels, "
            f"{misfit / spread:.0%} of the points' spread"
        )
    decisions: dict[str, Any] = {
        "warp model": sorted({report.model for report in warps.reports}),
        "edges": {"tree": graph.n_tree, "extra": len(graph.edges) - graph.n_tree},
        "disagreement of warps around triangles (median)": _median(cycles.disagreement),
        "warp residual in pixels (median)": (_median(warps.residual) or 0.0) * tracks.focal_length(),
        "integration bending weight": solved.integrated.bending,
        "convergence index": solved.index_history,
        "scale convention": "each image is scaled so that the median conformal scale of the edges is 1",
    }
    costs = {"differential solve": solved.cost_history}
    if refined is not None:
        decisions |= {"model": refined.model, "refinement": refined.evidence}
        decisions["scale convention"] = "each image is scaled so that edge lengths agree with those of all images"
        costs["refinement"] = list(refined.cost_history)
        warnings += refined.warnings
    return RunRecord(
        source="",
        method="connrsfm",
        seed=config.seed,
        configuration=as_dict(config),
        decisions=decisions,
        warnings=tuple(warnings),
        cost_history=costs,
        seconds=dict(progress.seconds),
        peak_memory_mib=peak_memory_mib(),
        versions=package_versions(),
    )


def _median(values: np.ndarray) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None
