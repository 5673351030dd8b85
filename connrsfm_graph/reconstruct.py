"""The main job: tracks and a configuration in, a reconstruction and its record out, stage by stage.

    tracks -> image graph -> warps -> problem -> pre-step -> solve and integrate -> refine -> surfaces

Every stage is a function of frozen data and can be called alone. Of a long sequence the stages see the keyframes only;
the other images follow these in blocks.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from threadpoolctl import threadpool_limits

from connrsfm_graph.config import as_dict
from connrsfm_graph.errors import ComputationError
from connrsfm_graph.image_graph import GraphConfig, ImageGraph, select_edges
from connrsfm_graph.initialise import Start, initialise
from connrsfm_graph.integrate import IntegrationConfig
from connrsfm_graph.keyframes import KeyframeConfig, choose_keyframes
from connrsfm_graph.orthographic import in_own_unit, in_unit_of, refine_from_afar
from connrsfm_graph.others import Guide, Others, reconstruct_others
from connrsfm_graph.problem import Problem, make_problem
from connrsfm_graph.progress import Progress
from connrsfm_graph.reconstruction import Reconstruction, RunRecord, package_versions, peak_memory_mib
from connrsfm_graph.refine import RefineConfig, Refined, refine
from connrsfm_graph.solvers.batched import BatchedBackend
from connrsfm_graph.solvers.gtsam_backend import GtsamBackend
from connrsfm_graph.solvers.interface import Backend
from connrsfm_graph.solvers.separable import SolveConfig, Solved, solve
from connrsfm_graph.surfaces import Surfaces, scales, surfaces_of_points, surfaces_of_terms
from connrsfm_graph.tracks import Tracks
from connrsfm_graph.warps import WarpConfig, Warps, estimate_pixel_noise, fit_warps
from connrsfm_graph.warps.cycles import cycle_agreement

NOISY = 0.05
"""Misfit of the warps, relative to the points' spread, from which the user is warned."""
BLOCK = 32
"""Images that follow the keyframes at a time."""


@dataclass(frozen=True)
class Config:
    """Settings of every stage."""

    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    """Which images of a long sequence are reconstructed jointly."""
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


@dataclass(frozen=True)
class Joint:
    """Images reconstructed jointly, with all that the stages found."""

    graph: ImageGraph
    warps: Warps
    problem: Problem
    solved: Solved
    refined: Refined | None
    surfaces: Surfaces
    conformal_scale: np.ndarray
    """(E, P) on the edges of the graph, NaN where a pair was not observed."""
    bending: float
    """Bending weight of the splines that give the surfaces' terms."""


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
    if tracks.camera.kappa:
        return _reconstruct(tracks, config, progress)
    scaled, unit = in_own_unit(tracks)
    result, record = _reconstruct(scaled, orthographic_settings(config), progress)
    return in_unit_of(tracks, result, unit), record


def _reconstruct(tracks: Tracks, config: Config, progress: Progress) -> tuple[Reconstruction, RunRecord]:
    keys = np.arange(tracks.n_frames)
    if config.refinement:
        keys = choose_keyframes(tracks.visible, config.keyframes, config.graph.min_shared)
    joint = reconstruct_jointly(tracks.select(frames=keys), config, progress)
    others: list[tuple[np.ndarray, Others]] = []
    rest = np.setdiff1d(np.arange(tracks.n_frames), keys)
    if len(rest):
        guide = make_guide(tracks.select(frames=keys), joint, config)
        with progress.stage("other images"):
            for first in range(0, len(rest), BLOCK):
                part = tracks.select(frames=rest[first : first + BLOCK])
                others.append((rest[first : first + BLOCK], reconstruct_others(guide, part.normalised(), part.visible)))
                progress.update(min(first + BLOCK, len(rest)), len(rest))
    return _gathered(tracks, keys, joint, others), _record(tracks, config, keys, joint, others, progress)


def reconstruct_jointly(tracks: Tracks, config: Config, progress: Progress) -> Joint:
    """All stages, of all images together; arguments and errors as for `reconstruct`."""
    image, visible = tracks.normalised(), tracks.visible
    with progress.stage("image graph"):
        graph = select_edges(visible, config.graph, image)
    with progress.stage("warps"):
        warps = fit_warps(image, visible, graph.edges, config.warps, progress.update)
    problem = make_problem(image, visible, graph.edges, warps.jets, warps.weight * warps.valid, tracks.camera)
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
            refined = (refine if tracks.camera.kappa else refine_from_afar)(
                image, visible, log_depth, config.refine, sigma, progress.update
            )
    with progress.stage("surfaces"):
        if refined is None:
            surfaces, bending = surfaces_of_terms(problem, solved), solved.integrated.bending
        else:
            constrained = problem.constrained().T & visible
            surfaces, bending = surfaces_of_points(refined, constrained, problem.camera)
        conformal_scale = scales(problem, surfaces.frame())
    return Joint(graph, warps, problem, solved, refined, surfaces, conformal_scale, bending)


def orthographic_settings(config: Config) -> Config:
    """The settings for orthographic cameras: all images jointly, and no rows that tell mirror images apart."""
    return replace(
        config,
        keyframes=replace(config.keyframes, most=None),
        solve=replace(config.solve, noise=replace(config.solve.noise, extrinsic=math.inf)),
    )


def make_backend(name: str) -> Backend:
    """The solver of the point-wise problem by name."""
    return GtsamBackend() if name == "gtsam" else BatchedBackend()


def make_guide(tracks: Tracks, joint: Joint, config: Config) -> Guide:
    """What other images need of keyframes that were reconstructed and refined jointly."""
    if joint.refined is None:
        raise ValueError("other images follow refined keyframes only")
    return Guide(
        image=np.where(tracks.visible[..., None], tracks.normalised(), 0.0),
        visible=tracks.visible,
        surfaces=joint.surfaces,
        reference=joint.refined.reference,
        bending=joint.bending,
        warps=joint.warps.config,
        refine=config.refine,
        min_shared=config.graph.min_shared,
        camera=joint.problem.camera,
    )


def _refuse_unrelated(problem: Problem, warps: Warps) -> None:
    """Say why an image has no usable warp, before integration finds nothing there."""
    for frame in np.flatnonzero(problem.constrained().sum(axis=0) < 3):
        mine = np.flatnonzero((warps.edges == frame).any(axis=1))
        reasons = [warps.reports[e].problem for e in mine if warps.reports[e].problem]
        raise ComputationError(
            f"image {frame} cannot be related to any other: {reasons[0] if reasons else 'no warp is usable'}; "
            "check its tracks for gross errors, or leave it out"
        )


def _gathered(
    tracks: Tracks, keys: np.ndarray, joint: Joint, others: Sequence[tuple[np.ndarray, Others]]
) -> Reconstruction:
    """Keyframes and other images in the order of the sequence."""
    parts = [(keys, joint.surfaces), *((frames, other.surfaces) for frames, other in others)]
    order = np.argsort(np.concatenate([frames for frames, _ in parts]))

    def gathered(name: str) -> np.ndarray:
        return np.concatenate([getattr(surfaces, name) for _, surfaces in parts])[order]

    edges = [keys[joint.graph.edges]]
    edges += [np.sort(np.stack([keys[other.keyframe], frames], axis=1), axis=1) for frames, other in others]
    scale = [joint.conformal_scale]
    for frames, other in others:  # edges run from the lower image to the higher
        backwards = (frames < keys[other.keyframe])[:, None]
        scale.append(np.where(backwards, 1.0 / other.conformal_scale, other.conformal_scale))
    ambiguous = gathered("ambiguous")
    return Reconstruction(
        pixels=tracks.pixels,
        K=tracks.K,
        visible=tracks.visible,
        points=gathered("points"),
        normals=gathered("normals"),
        depth=gathered("depth"),
        first_order=gathered("first_order"),
        second_order=gathered("second_order"),
        edges=np.concatenate(edges),
        edge_weight=np.concatenate([joint.graph.weight, *(other.edge_weight for _, other in others)]),
        conformal_scale=np.concatenate(scale),
        depth_std=gathered("depth_std"),
        log_factor=gathered("log_factor"),
        interpolated=gathered("interpolated"),
        outlier=gathered("outlier"),
        image_names=None if tracks.image_names is None else np.asarray(tracks.image_names),
        ambiguous=None if joint.surfaces.alternative is None else ambiguous,
        alternative=None if joint.surfaces.alternative is None else gathered("alternative"),
        camera=tracks.camera,
    )


def _record(
    tracks: Tracks,
    config: Config,
    keys: np.ndarray,
    joint: Joint,
    others: Sequence[tuple[np.ndarray, Others]],
    progress: Progress,
) -> RunRecord:
    graph, warps, solved, refined = joint.graph, joint.warps, joint.solved, joint.refined
    reports = zip(keys[warps.edges], warps.reports, strict=True)
    problems = [((a, b), report.problem) for (a, b), report in reports if report.problem]
    for frames, other in others:
        ends = zip(keys[other.keyframe], frames, other.problem, strict=True)
        problems += [((a, b), problem) for a, b, problem in ends if problem]
    warnings = [f"warp from image {a} to image {b}: {problem}" for (a, b), problem in problems[:5]]
    if len(problems) > 5:
        warnings.append(f"{len(problems) - 5} more warps had problems")
    cycles = cycle_agreement(warps)
    suspects = cycles.suspects()
    if len(suspects):
        pairs = ", ".join(f"{a}-{b}" for a, b in keys[warps.edges[suspects[:5]]])
        warnings.append(f"{len(suspects)} warps disagree with the others around cycles of the image graph ({pairs})")
    spread = float(np.nanmedian(np.nanstd(tracks.pixels, axis=1)))
    if (misfit := (_median(warps.residual) or 0.0) * tracks.focal_length()) > NOISY * spread:
        warnings.append(
            f"the tracks are very noisy or no smooth surface: warps miss by {misfit:.3g} pixels, "
            f"{misfit / spread:.0%} of the points' spread"
        )
    decisions: dict[str, Any] = {
        "warp model": sorted({report.model for report in warps.reports}),
        "keyframes": {"jointly": len(keys), "following": tracks.n_frames - len(keys)},
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
    if not tracks.camera.kappa:
        decisions["scale convention"] = "each image is in the unit of length of its intrinsics"
        decisions["mirror images"] = "second fundamental forms agree, most of the surface bulges towards the camera"
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
