"""Which pairs of images are related by a warp: a maximum spanning tree and the best edges beside it.

Every pair of images that shares enough tracks is an edge of the complete image graph, weighted by the number of shared
tracks. Using all of them costs a warp each; the maximum spanning tree is the least that links all images. Further edges
are the k that raise the weighted number of spanning trees most (k-ESP; Khosoussi et al., "Reliable graphs for SLAM",
IJRR 2019), which is log det of the reduced weighted Laplacian. One edge e of weight w raises it by log(1 + w R_e) with
R_e the effective resistance between its ends (matrix determinant lemma). The gain is monotone and submodular, so taking
the best edge again and again reaches at least (1 - 1/e) of the best possible gain.

Ties are frequent (with all points seen in all images every weight is equal) and go to the pair whose image change is
nearest the median over all pairs: two images that look alike say little about the surface, and the most different
ones are the hardest to warp.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import networkx as nx
import numpy as np
from scipy.sparse import coo_array, csc_array
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import SuperLU, splu

from connrsfm_graph.errors import InputError

_BLOCK = 256
"""Rows, columns or rank-1 updates treated at once; bounds the memory, not the result."""
_TIE = 1e-9
"""Gains closer than this, relatively, are ties."""


@dataclass(frozen=True)
class GraphConfig:
    """How many pairs of images are related by a warp, and which are allowed."""

    extra_per_frame: float = 2.0
    """Edges beside the spanning tree, as a multiple of the number of images."""
    extra_edges: int | None = None
    """Edges beside the spanning tree, absolute; overrides `extra_per_frame`."""
    max_extra: int = 120
    """No more than this by `extra_per_frame`: eliminating a point's images costs the more the more cycles there are,
    and on a tree with a bounded number of extra edges it stays linear in the number of images."""
    min_shared: int = 6
    """Fewest shared tracks of a pair: an affinity has six parameters, three points leave nothing to check a warp by."""
    weight: Literal["shared", "parallax"] = "shared"
    """`shared`: number of shared tracks. `parallax`: reduced in proportion where a pair's image change is below the
    median, for videos whose neighbouring images hardly differ."""
    complete_up_to: int = 400
    """Up to this many images every pair is a candidate; beyond, see `neighbours`."""
    neighbours: int = 32
    """In longer sequences the candidates of an image are this many images that share most tracks with it, and those
    1, 2, 4, 8, ... images away; doubled until they link all images, if the complete graph does."""

    def __post_init__(self) -> None:
        if not 0 <= self.extra_per_frame < np.inf:
            raise InputError(f"graph.extra_per_frame is {self.extra_per_frame}, expected a number from 0")
        for name, least in (
            ("extra_edges", 0),
            ("max_extra", 0),
            ("min_shared", 3),
            ("complete_up_to", 0),
            ("neighbours", 1),
        ):
            value = getattr(self, name)
            if value is not None and value < least:
                raise InputError(f"graph.{name} is {value}, expected at least {least}")


@dataclass(frozen=True)
class ImageGraph:
    """Selected edges of the image graph."""

    n_frames: int
    edges: np.ndarray
    """(E, 2) int, images a < b of each edge; the warp of an edge maps image a to image b. Tree edges first."""
    weight: np.ndarray
    """(E,) weight of each edge."""
    n_tree: int
    """The first n_tree edges are the maximum spanning tree."""


def select_edges(visible: np.ndarray, config: GraphConfig | None = None, image: np.ndarray | None = None) -> ImageGraph:
    """Choose the pairs of images to relate.

    Args:
        visible: (F, P) bool, which point is seen in which image.
        config: numbers and limits.
        image: (F, P, 2) image coordinates for the image change of a pair (any unit; not read where not visible).
            Without them ties go to the lower image numbers, and `weight` must be `shared`.

    Raises:
        InputError: fewer than two images, or images that no chain of pairs with enough shared tracks links; the
            message names the groups.
        ValueError: `weight="parallax"` without `image`.
    """
    config = config or GraphConfig()
    n_frames = visible.shape[0]
    if n_frames < 2:
        raise InputError(f"{n_frames} image given, expected at least two to relate to each other")
    pairs, weight = _candidates(visible, config)
    if image is not None:
        change = image_change(visible, image, pairs)
        median = np.median(change)
        if config.weight == "parallax" and median > 0:
            weight *= np.clip(change / median, 1e-3, 1.0)
        order = np.argsort(np.abs(np.log(np.maximum(change, 1e-12) / max(median, 1e-12))), kind="stable")
        pairs, weight = pairs[order], weight[order]
    elif config.weight == "parallax":
        raise ValueError("the weight 'parallax' needs the image coordinates")

    tree = _maximum_spanning_tree(n_frames, pairs, weight)
    wanted = config.extra_edges
    if wanted is None:
        wanted = min(round(config.extra_per_frame * n_frames), config.max_extra)
    chosen = np.concatenate([tree, greedy_edges(n_frames, pairs, weight, tree, wanted)])
    return ImageGraph(n_frames, pairs[chosen], weight[chosen], len(tree))


def image_change(visible: np.ndarray, image: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Share of the layout of a pair's common points that no similarity of the image plane explains, (E,) in [0, 1].

    With centred points as complex numbers z it is 1 - |<z_a, z_b>|^2 / (|z_a|^2 |z_b|^2), the same in both directions.
    """
    z = np.where(visible, image[..., 0] + 1j * image[..., 1], 0.0)
    change = np.empty(len(pairs))
    for start in range(0, len(pairs), _BLOCK):
        a, b = pairs[start : start + _BLOCK].T
        both = visible[a] & visible[b]
        count = np.maximum(both.sum(axis=1, keepdims=True), 1)
        za, zb = (np.where(both, z[k] - np.where(both, z[k], 0).sum(axis=1, keepdims=True) / count, 0) for k in (a, b))
        sizes = (np.abs(za) ** 2).sum(axis=1) * (np.abs(zb) ** 2).sum(axis=1)
        explained = np.abs((za.conj() * zb).sum(axis=1)) ** 2
        change[start : start + _BLOCK] = 1 - np.divide(explained, sizes, out=np.ones(len(a)), where=sizes > 0)
    return np.clip(change, 0.0, 1.0)


def greedy_edges(n_frames: int, pairs: np.ndarray, weight: np.ndarray, start: np.ndarray, extra: int) -> np.ndarray:
    """Indices of up to `extra` candidate edges that greedily maximise log det of the reduced Laplacian.

    Args:
        n_frames: number of nodes.
        pairs: (E, 2) candidate edges, the preferred ones first (ties go to the earlier).
        weight: (E,) positive weights.
        start: indices of edges already taken; they must connect all nodes.
        extra: number of edges to add.

    The Laplacian is factorised anew after every block of additions; in between the potentials u = L^-1 a_e of a new
    edge follow from rank-1 updates, and with them the effective resistance of all candidates,
    R_f -= w_e (a_f . u)^2 / (1 + w_e R_e).
    """
    weight = weight / weight.max()
    available = np.ones(len(pairs), dtype=bool)
    available[start] = False
    taken = list(start)
    extra = max(0, min(extra, int(available.sum())))
    a, b = pairs.T
    while extra > 0:
        factor = _factorise(n_frames, pairs[taken], weight[taken])
        if len(taken) == len(start):
            resistance = _resistances(factor, n_frames, pairs)
        steps = min(extra, _BLOCK)
        updates = np.zeros((n_frames, steps))
        for step in range(steps):
            gain = np.where(available, weight * resistance, -1.0)
            e = int(np.argmax(gain >= (1 - _TIE) * gain.max()))
            u = _potentials(factor, n_frames, a[e], b[e])
            u -= updates[:, :step] @ (updates[a[e], :step] - updates[b[e], :step])
            scaled = u * np.sqrt(weight[e] / (1 + weight[e] * (u[a[e]] - u[b[e]])))
            resistance -= (scaled[a] - scaled[b]) ** 2
            updates[:, step] = scaled
            available[e] = False
            taken.append(e)
        extra -= steps
    return np.array(taken[len(start) :], dtype=np.int64)


def _candidates(visible: np.ndarray, config: GraphConfig) -> tuple[np.ndarray, np.ndarray]:
    """Pairs a < b that may be chosen in lexicographic order (E, 2), and how many tracks they share (E,) float."""
    n_frames = visible.shape[0]
    neighbours = n_frames if n_frames <= config.complete_up_to else config.neighbours
    while True:
        pairs = _sharing_pairs(visible, config.min_shared, neighbours)
        adjacency = coo_array((np.ones(len(pairs), dtype=bool), tuple(pairs.T)), shape=(n_frames, n_frames))
        n_groups, group = connected_components(adjacency, directed=False)
        if n_groups == 1:
            break
        if neighbours >= n_frames:
            raise InputError(_describe_groups(group, config.min_shared))
        neighbours *= 2
    shared = np.empty(len(pairs))
    for start in range(0, len(pairs), _BLOCK):
        a, b = pairs[start : start + _BLOCK].T
        shared[start : start + _BLOCK] = (visible[a] & visible[b]).sum(axis=1)
    return pairs, shared


def _sharing_pairs(visible: np.ndarray, min_shared: int, neighbours: int) -> np.ndarray:
    """Pairs a < b with enough shared tracks; of every image only the best partners and those 1, 2, 4, ... away."""
    n_frames = visible.shape[0]
    seen = visible.astype(np.float32)
    steps = 2 ** np.arange(int(np.log2(n_frames)) + 1)
    steps = np.concatenate([-steps, steps])
    keys = []
    for first in range(0, n_frames, _BLOCK):
        shared = seen[first : first + _BLOCK] @ seen.T
        rows = np.arange(len(shared))[:, None]
        shared[rows, first + rows] = 0.0
        allowed = shared >= min_shared
        if neighbours < n_frames:
            near = np.zeros_like(allowed)
            near[rows, np.argpartition(-shared, neighbours, axis=1)[:, :neighbours]] = True
            near[rows, np.clip(first + rows + steps, 0, n_frames - 1)] = True
            allowed &= near
        i, b = np.nonzero(allowed)
        keys.append(np.minimum(i + first, b) * n_frames + np.maximum(i + first, b))
    return np.column_stack(np.divmod(np.unique(np.concatenate(keys)), n_frames))


def _describe_groups(group: np.ndarray, min_shared: int) -> str:
    n_groups = group.max() + 1
    listed = "; ".join(_ranges(np.flatnonzero(group == g)) for g in range(min(n_groups, 6)))
    more = "; ..." if n_groups > 6 else ""
    return (
        f"the images fall into {n_groups} groups that share fewer than {min_shared} tracks with each other "
        f"(frames {listed}{more}): add tracks that link the groups, or reconstruct each one alone"
    )


def _ranges(frames: np.ndarray) -> str:
    """Sorted numbers in short form: ``0-4, 7``."""
    cuts = np.flatnonzero(np.diff(frames) != 1) + 1
    runs = [frames[i:j] for i, j in pairwise([0, *cuts.tolist(), len(frames)])]
    return ", ".join(str(run[0]) if len(run) == 1 else f"{run[0]}-{run[-1]}" for run in runs)


def _maximum_spanning_tree(n_frames: int, pairs: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Indices of the tree's edges, heaviest first; among equal weights the earlier candidate wins.

    The tree depends on the order of the weights only, so it is the minimum spanning tree of the ranks, which have no
    ties and make the choice independent of the order in which networkx visits edges.
    """
    order = np.argsort(-weight, kind="stable")
    graph = nx.Graph()
    graph.add_nodes_from(range(n_frames))
    graph.add_weighted_edges_from((a, b, rank) for rank, (a, b) in enumerate(pairs[order].tolist()))
    tree = nx.minimum_spanning_edges(graph, algorithm="kruskal", data=True)
    return order[[data["weight"] for _, _, data in tree]]


def _factorise(n_frames: int, edges: np.ndarray, weight: np.ndarray) -> SuperLU:
    """Sparse factors of the Laplacian with node 0 grounded."""
    a, b = edges.T
    rows, columns = np.concatenate([a, b, a, b]), np.concatenate([a, b, b, a])
    values = np.concatenate([weight, weight, -weight, -weight])
    laplacian = csc_array(coo_array((values, (rows, columns)), shape=(n_frames, n_frames)))
    return splu(laplacian[1:, 1:], permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})


def _potentials(factor: SuperLU, n_frames: int, a: int, b: int) -> np.ndarray:
    """Node potentials (F,), zero at node 0, when a unit current enters at a and leaves at b."""
    current = np.zeros(n_frames)
    current[a], current[b] = 1.0, -1.0
    return np.concatenate([[0.0], factor.solve(current[1:])])


def _resistances(factor: SuperLU, n_frames: int, pairs: np.ndarray) -> np.ndarray:
    """Effective resistance (E,) between the ends of every pair: G_aa + G_bb - 2 G_ab of the grounded inverse G."""
    a, b = pairs.T
    diagonal = np.zeros(n_frames)
    mutual = np.zeros(len(pairs))
    for first in range(0, n_frames, _BLOCK):
        columns = np.arange(first, min(first + _BLOCK, n_frames))
        current = (np.arange(n_frames)[:, None] == columns).astype(np.float64)[1:]
        inverse = np.concatenate([np.zeros((1, len(columns))), factor.solve(current)])
        inverse[:, columns == 0] = 0.0
        diagonal[columns] = inverse[columns, columns - first]
        here = np.flatnonzero((b >= first) & (b < first + len(columns)))
        mutual[here] = inverse[a[here], b[here] - first]
    return diagonal[a] + diagonal[b] - 2 * mutual
