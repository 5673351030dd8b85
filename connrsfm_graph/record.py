"""What a run says about itself: what was decided from the data, what may be wrong, and the resources it took."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from connrsfm_graph.image_graph import ImageGraph
from connrsfm_graph.refine import Refined
from connrsfm_graph.solvers.separable import Solved
from connrsfm_graph.tracks import Tracks
from connrsfm_graph.warps import Warps
from connrsfm_graph.warps.cycles import cycle_agreement

NOISY = 0.05
"""Misfit of the warps, relative to the points' spread, from which the user is warned."""
_TOLD = 5
"""Problems that are told one by one."""


@dataclass(frozen=True)
class Account:
    """What is to be said about images that were reconstructed jointly."""

    decisions: dict[str, Any]
    """What was chosen from the data, by name."""
    problems: tuple[tuple[int, int, str], ...]
    """Images a and b of a warp, and what is wrong with it."""
    warnings: tuple[str, ...]
    """One sentence each."""
    cost_history: dict[str, list[float]]
    """Cost after each iteration, by stage."""


def account_of(
    tracks: Tracks, keys: np.ndarray, graph: ImageGraph, warps: Warps, solved: Solved, refined: Refined | None
) -> Account:
    """What the stages found.

    Args:
        tracks: of the K images reconstructed jointly.
        keys: (K,) their numbers in the whole sequence.
        graph, warps, solved, refined: outcome of the stages.
    """
    reports = zip(keys[warps.edges].tolist(), warps.reports, strict=True)
    problems = tuple((a, b, report.problem) for (a, b), report in reports if report.problem)
    warnings = []
    cycles = cycle_agreement(warps)
    suspects = cycles.suspects()
    if len(suspects):
        pairs = ", ".join(f"{a}-{b}" for a, b in keys[warps.edges[suspects[:_TOLD]]])
        warnings.append(f"{len(suspects)} warps disagree with the others around cycles of the image graph ({pairs})")
    spread = float(np.nanmedian(np.nanstd(tracks.pixels, axis=1)))
    misfit = (_median(warps.residual) or 0.0) * tracks.focal_length()
    if misfit > NOISY * spread:
        warnings.append(
            f"the tracks are very noisy or no smooth surface: warps miss by {misfit:.3g} pixels, "
            f"{misfit / spread:.0%} of the points' spread"
        )
    decisions: dict[str, Any] = {
        "warp model": sorted({report.model for report in warps.reports}),
        "edges": {"tree": graph.n_tree, "extra": len(graph.edges) - graph.n_tree},
        "disagreement of warps around triangles (median)": _median(cycles.disagreement),
        "warp residual in pixels (median)": misfit,
        "integration bending weight": solved.integrated.bending,
        "convergence index": solved.index_history,
        "scale convention": "each image is scaled so that the median conformal scale of the edges is 1",
    }
    if solved.row_noise is not None:
        decisions["sigmas of the pair factors' rows"] = dict(solved.row_noise.sigma)
        decisions["share of the warps in their squares"] = dict(solved.row_noise.share)
    costs = {"differential solve": list(solved.cost_history)}
    if refined is not None:
        decisions |= {"model": refined.model, "refinement": dict(refined.evidence)}
        decisions["scale convention"] = "each image is scaled so that edge lengths agree with those of all images"
        costs["refinement"] = list(refined.cost_history)
        warnings += refined.warnings
    if not tracks.camera.kappa:
        decisions["scale convention"] = "each image is in the unit of length of its intrinsics"
        decisions["mirror images"] = "second fundamental forms agree, most of the surface bulges towards the camera"
    return Account(decisions, problems, tuple(warnings), costs)


def problem_warnings(problems: Iterable[tuple[int, int, str]]) -> list[str]:
    """The first few problems of warps, and how many more there are."""
    problems = list(problems)
    told = [f"warp from image {a} to image {b}: {problem}" for a, b, problem in problems[:_TOLD]]
    return told + ([f"{len(problems) - _TOLD} more warps had problems"] if len(problems) > _TOLD else [])


def _median(values: np.ndarray) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None
