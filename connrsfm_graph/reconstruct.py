"""The main job: tracks and a configuration in, a reconstruction and its record out, stage by stage.

    tracks -> image graph -> warps -> problem -> pre-step -> solve and integrate -> refine -> surfaces

Every stage is a function of frozen data and can be called alone. Of a long sequence the stages see the keyframes only;
the other images follow these in blocks.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from threadpoolctl import threadpool_limits

from connrsfm_graph.config import as_dict
from connrsfm_graph.depth_deviation import depth_deviation
from connrsfm_graph.errors import ComputationError, InputError
from connrsfm_graph.image_graph import GraphConfig, ImageGraph, select_edges
from connrsfm_graph.initialise import Start, initialise
from connrsfm_graph.integrate import IntegrationConfig
from connrsfm_graph.keyframes import KeyframeConfig, choose_keyframes
from connrsfm_graph.orthographic import in_own_unit, in_unit_of, refine_from_afar
from connrsfm_graph.others import Guide
from connrsfm_graph.problem import Problem, make_problem
from connrsfm_graph.progress import Progress
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.record import Account, account_of, problem_warnings
from connrsfm_graph.refine import RefineConfig, Refined, refine
from connrsfm_graph.run_record import RunRecord, package_versions, peak_memory_mib
from connrsfm_graph.running.checkpoints import Checkpoints
from connrsfm_graph.running.config import RunningConfig
from connrsfm_graph.running.crew import Here, Plan, assembled
from connrsfm_graph.running.follow import follow_keyframes
from connrsfm_graph.running.gather import Gathering
from connrsfm_graph.solvers.batched import BatchedBackend
from connrsfm_graph.solvers.gtsam_backend import GtsamBackend
from connrsfm_graph.solvers.interface import Backend
from connrsfm_graph.solvers.separable import SolveConfig, Solved, solve
from connrsfm_graph.surfaces import Surfaces, scales, surfaces_of_points, surfaces_of_terms
from connrsfm_graph.tracks import Tracks
from connrsfm_graph.warps import WarpConfig, Warps, estimate_pixel_noise, fit_warps


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
    running: RunningConfig = field(default_factory=RunningConfig)
    """How the run is carried out; no result depends on it."""

    def __post_init__(self) -> None:
        if self.seed < 0:
            raise InputError(f"seed is {self.seed}, expected 0 or more")


def default_config(mode: Literal["default", "paper"] = "default") -> Config:
    """The best known settings, or the published algorithm as written."""
    if mode == "default":
        return Config()
    return Config(
        warps=WarpConfig(model="schwarzian"), solve=SolveConfig(schedule="separable", sigmas="fixed"), refinement=False
    )


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


@dataclass(frozen=True)
class Keyframes:
    """What is kept of images reconstructed jointly."""

    graph: ImageGraph
    surfaces: Surfaces
    conformal_scale: np.ndarray
    """(E, P) on the edges of the graph, NaN where a pair was not observed."""
    guide: Guide | None
    """What other images need of them; None where there are no others."""
    account: Account
    """What is to be said about them."""


@threadpool_limits.wrap(limits=1, user_api="blas")
def reconstruct(
    tracks: Tracks,
    config: Config | None = None,
    progress: Progress | None = None,
    checkpoints: Checkpoints | None = None,
) -> tuple[Reconstruction, RunRecord]:
    """Reconstruct the surface of every image.

    The dense systems are small and many: threads run over points and images in compiled code, BLAS is held to one.

    Args:
        tracks: checked tracks (see `tracks.check_reconstructable` for what makes them reconstructable).
        config: settings; the defaults where None.
        progress: times and shows the stages.
        checkpoints: where finished stages and blocks are kept, and a result that is large for the memory lies on disk
            (its arrays are then mapped to files there); None keeps all in memory.

    Raises:
        InputError: the tracks cannot be used (for example, groups of images share no tracks).
        ComputationError: a stage failed.
    """
    config, progress, checkpoints = config or Config(), progress or Progress(), checkpoints or Checkpoints()
    if tracks.camera.kappa:
        return _reconstruct(tracks, config, progress, checkpoints)
    scaled, unit = in_own_unit(tracks)
    result, record = _reconstruct(scaled, orthographic_settings(config), progress, checkpoints)
    return in_unit_of(tracks, result, unit), record


def _reconstruct(
    tracks: Tracks, config: Config, progress: Progress, checkpoints: Checkpoints
) -> tuple[Reconstruction, RunRecord]:
    keys = np.arange(tracks.n_frames)
    if config.refinement:
        keys = choose_keyframes(tracks.visible, config.keyframes, config.graph.min_shared)
    n_following = tracks.n_frames - len(keys)
    plan = Plan.of(config.running, tracks.n_frames, n_following, tracks.n_points)
    with assembled(config.running, plan) if n_following else Here() as crew:
        joint = checkpoints.kept(
            "keyframes", Keyframes, lambda: _keyframes(tracks, keys, config, progress, checkpoints)
        )
        folder = checkpoints.folder / "arrays" if plan.on_disk and checkpoints.folder is not None else None
        gathering = Gathering(tracks, keys, joint.graph, joint.surfaces, joint.conformal_scale, folder)
        peaks: dict[str, float] = {}
        if joint.guide is not None:
            with progress.stage("other images"):
                peaks = follow_keyframes(tracks, joint.guide, gathering, crew, plan, checkpoints, progress)
    account = joint.account
    decisions = account.decisions | {"keyframes": {"jointly": len(keys), "following": n_following}}
    if n_following:
        decisions["running"] = {"processes at work": max(len(peaks), 1), "images in a block": plan.block}
    warnings = [*problem_warnings((*account.problems, *gathering.problems())), *account.warnings]
    if config.running.cluster is not None and not n_following:
        warnings.append(f"the cluster was not asked: all {tracks.n_frames} images are reconstructed jointly, here")
    peak = peak_memory_mib() + sum(peaks.values())
    if config.running.memory_limit is not None and peak * 2**20 > config.running.memory():
        warnings.append(f"the run took {peak:.0f} MiB, more than running.memory_limit ({config.running.memory_limit})")
    record = RunRecord(
        source="",
        method="connrsfm",
        seed=config.seed,
        configuration=as_dict(config),
        decisions=decisions,
        warnings=tuple(warnings),
        cost_history=account.cost_history,
        seconds=dict(progress.seconds),
        peak_memory_mib=peak,
        versions=package_versions(),
    )
    return gathering.result(), record


def _keyframes(
    tracks: Tracks, keys: np.ndarray, config: Config, progress: Progress, checkpoints: Checkpoints
) -> Keyframes:
    part = tracks.select(frames=keys)
    joint = reconstruct_jointly(part, config, progress, checkpoints)
    guide = make_guide(part, joint, config) if len(keys) < tracks.n_frames else None
    account = account_of(part, keys, joint.graph, joint.warps, joint.solved, joint.refined)
    return Keyframes(joint.graph, joint.surfaces, joint.conformal_scale, guide, account)


def reconstruct_jointly(
    tracks: Tracks, config: Config, progress: Progress, checkpoints: Checkpoints | None = None
) -> Joint:
    """All stages, of all images together; arguments and errors as for `reconstruct`."""
    checkpoints = checkpoints or Checkpoints()
    image, visible = tracks.normalised(), tracks.visible
    with progress.stage("image graph"):
        graph = select_edges(visible, config.graph, image)
    with progress.stage("warps"):
        warps = checkpoints.kept(
            "warps", Warps, lambda: fit_warps(image, visible, graph.edges, config.warps, progress.update)
        )
    problem = make_problem(image, visible, graph.edges, warps.jets, warps.weight * warps.valid, tracks.camera)
    _refuse_unrelated(problem, warps)
    backend = make_backend(config.solve.backend)

    def differentially() -> Solved:
        with progress.stage("pre-step"):
            start = initialise(problem, backend, config.solve.levenberg, config.start, config.seed)
        with progress.stage("solve"):
            covariance = warps.jets.covariance
            return solve(problem, start, backend, config.solve, config.integrate, progress.update, covariance)

    solved = checkpoints.kept("solve", Solved, differentially)
    refined = None
    with progress.stage("noise level"):
        sigma = estimate_pixel_noise(image, visible, graph.edges)
    if config.refinement:
        with progress.stage("refinement"):
            log_depth = np.where(visible, solved.state.log_depth.T, np.nan)
            refined = (refine if tracks.camera.kappa else refine_from_afar)(
                image, visible, log_depth, config.refine, sigma, progress.update
            )
    with progress.stage("surfaces"):
        if refined is None:
            deviation = depth_deviation(solved.weighed(problem), solved, config.solve, config.integrate, sigma)
            surfaces, bending = surfaces_of_terms(problem, solved, deviation), solved.integrated.bending
        else:
            constrained = problem.constrained().T & visible
            surfaces, bending = surfaces_of_points(refined, constrained, problem.camera)
        conformal_scale = scales(problem, surfaces.frame(), surfaces.log_factor)
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
        warps=replace(joint.warps.config, covariance=False),
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
