"""A fusion problem as a drawing in Graphviz' dot language.

The graph of a fusion has thousands of map points, so its drawing has a node per view for the camera and one for the
surface it saw, and one for all other variables of a kind; edges say how many factors they stand for. Of many views,
neighbours are drawn as one, so that the drawing stays small. (`solvers.gtsam_backend.write_dot` draws every variable
and factor of a small graph.)
"""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np

from connrsfm_graph.files import written_beside
from connrsfm_graph.slam.storage import FusionProblem
from factors.keys import CAMERA_POSE, RIGID_LANDMARK, VIEW_SCALE, decode

MOST_GROUPS = 50
"""Nodes that views are drawn as, at most."""


def write_drawing(path: str | Path, problem: FusionProblem, most: int = MOST_GROUPS) -> None:
    """Write the graph of a fusion as `.dot`.

    Args:
        path: of the file.
        problem: what is fused.
        most: nodes that views are drawn as, at most.
    """
    F = problem.sightings.n_views
    size = -(-F // most)
    group = np.arange(F) // size
    lines = ["graph fusion {", "  rankdir=LR;", "  fontname=Helvetica;"]
    lines += ["  node [shape=box, fontname=Helvetica];", "  edge [fontname=Helvetica, fontsize=9];"]
    for name, label in (("camera", "cameras: pose and scale"), ("surface", "map points")):
        lines += [f"  subgraph cluster_{name} {{", f'    label="{label}";']
        for n in range(int(group[-1]) + 1):
            first, last = n * size, min((n + 1) * size, F) - 1
            views = f"view {first}" if first == last else f"views {first} to {last}"
            lines.append(f'    {name}_{n} [label="{views}"];')
        lines.append("  }")
    others, joined = _given(problem, group)
    for letter, keys in sorted(others.items()):
        lines.append(f'  other_{ord(letter)} [shape=ellipse, label="{_name(letter)}: {len(keys)}"];')
    for (a, b, label), count in sorted((joined + _of_map(problem, group)).items()):
        lines.append(f'  {a} -- {b} [label="{label}: {count}"];')
    with written_beside(path) as part:
        part.write_text("\n".join([*lines, "}"]) + "\n", encoding="utf-8")


def _given(problem: FusionProblem, group: np.ndarray) -> tuple[dict[str, set[int]], Counter[tuple[str, str, str]]]:
    """Variables that are no cameras by letter, and factors of the given graph by the nodes they join.

    A factor on more than two nodes joins the first to each of the others, one on a single node joins it to itself.
    """
    others: dict[str, set[int]] = {}
    joined: Counter[tuple[str, str, str]] = Counter()
    for n in range(problem.graph.size()):
        factor = problem.graph.at(n)
        if factor is None:
            continue
        nodes: list[str] = []
        for k in factor.keys():
            letter, _, view = decode(k)
            if letter in (CAMERA_POSE, VIEW_SCALE):
                node = f"camera_{group[view]}"
            else:
                others.setdefault(letter, set()).add(k)
                node = f"other_{ord(letter)}"
            if node not in nodes:
                nodes.append(node)
        for node in nodes[1:] or nodes:
            joined[nodes[0], node, _kind(type(factor).__name__)] += 1
    return others, joined


def _name(letter: str) -> str:
    """What variables with keys of a letter are called in the drawing."""
    if letter == RIGID_LANDMARK:
        return "rigid landmarks"
    return letter if letter.isalnum() else f"variables {ord(letter)}"


def _kind(factor: str) -> str:
    """What a class of factors is called in the drawing."""
    if factor.startswith("Between"):
        return "odometry"
    if factor.startswith("Prior"):
        return "prior"
    return "projection" if "Projection" in factor else factor


def _of_map(problem: FusionProblem, group: np.ndarray) -> Counter[tuple[str, str, str]]:
    """Anchors of every view, motions of map points from sighting to sighting, and links between scales."""
    joined: Counter[tuple[str, str, str]] = Counter()
    seen = problem.sightings.seen
    for view, count in enumerate(seen.sum(axis=1).tolist()):
        joined[f"camera_{group[view]}", f"surface_{group[view]}", "anchor"] += count
    for point in range(seen.shape[1]):
        views = group[np.flatnonzero(seen[:, point])]
        for a, b in zip(views[:-1].tolist(), views[1:].tolist(), strict=True):
            joined[f"surface_{a}", f"surface_{b}", "motion"] += 1
    for a, b in zip(group[:-1].tolist(), group[1:].tolist(), strict=True):
        joined[f"camera_{a}", f"camera_{b}", "scale link"] += 1
    return joined
