"""Which views of a conformal reconstruction might as well be inverted about the camera centre, and which not.

The inversion X -> X / |X|^2 keeps all sight rays and is conformal: no residual of images and lengths changes. So every
view of a purely conformal reconstruction is known up to one inversion. What decides, in this order:

1. Isometry. Two views, declared or found to be isometric, have equal conformal factors up to a constant; inverting
   one or both spoils that (unless they are seen from the same place).
2. The trace-free second fundamental form. Where the surface deforms like a piece of space under Moebius maps, it is
   the same in all views up to scale, and inverting a view turns its sign. Where the views share one form but for signs,
   they are decided but for one common inversion; a view that agrees too little with the others remains open.
3. The least variation of the conformal factor: a convention rather than knowledge. What only this has decided is
   reported as ambiguous.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from connrsfm_graph.refine.curvature import shear_kernel
from connrsfm_graph.refine.measurements import Shape
from connrsfm_graph.refine.mesh import Mesh
from connrsfm_graph.refine.restarts import inverted
from connrsfm_graph.threads import over_views

_ISOMETRIC = 0.005
"""Two views are isometric where the standard deviation of their difference in log conformal factor is below this."""
_MARGIN = 5.0
"""It must be larger by this factor for any other choice of inversions of the two."""
_AGREEMENT = 0.95
"""Least agreement of the views' signs at which these are believed."""
_SAME_FORM = (0.5, 0.2)
"""The views share one form where all correlations are above the first, or where this part of them at most is not
explained by one common form and each view's own noise."""
_MANY = 5
"""Views from which on the latter can be told."""
_LEAST_MARGIN = 0.1
"""Least mean correlation of a view with the others for its sign to be told."""
_FACTOR_STEPS = 50
"""Iterations of the fit of one common form."""
_CLIP = 3.0
"""Entries of these forms count up to so many times their median."""


@dataclass(frozen=True)
class Ambiguity:
    """How the inversions were decided."""

    group: np.ndarray
    """(F,) int: 0 for decided views; views of the same positive number may be inverted, but only all together."""
    isometric: np.ndarray
    """(F,) bool, views declared or found to be isometric to another one."""
    assumption: str
    """What decided, in words."""


def resolve(shape: Shape, image: np.ndarray, mesh: Mesh, declared: np.ndarray) -> tuple[Shape, Ambiguity]:
    """Invert views as far as isometry and the second fundamental forms ask for it.

    Args:
        shape: conformal shape.
        image: (F, P, 2) tracked image points.
        mesh: the mesh.
        declared: (F,) bool, views declared isometric to each other.
    """
    flip, isometric = isometric_views(shape, image, declared)
    shape = inverted(shape, image, flip)
    agreed = consensus(shear_correlation(shape.points(image), mesh))
    sign = agreed.sign * (agreed.sign[int(isometric.argmax())] if isometric.any() else 1.0)
    if agreed.agreement >= _AGREEMENT and (sign[isometric] > 0).all() and (agreed.same_form or not isometric.any()):
        told = isometric | (agreed.margin >= _LEAST_MARGIN)
        # Without a decided view the majority stays as it is.
        if not isometric.any() and (sign[told] > 0).sum() < told.sum() / 2:
            sign = -sign
        shape = inverted(shape, image, told & (sign < 0))
        if agreed.same_form:
            group = np.where(told, 0 if isometric.any() else 1, 1 + np.cumsum(~told))
            return shape, Ambiguity(group, isometric, "the trace-free second fundamental form is kept up to scale")
        assumption = "the trace-free second fundamental forms agree as well as they can"
        return shape, Ambiguity(np.cumsum(~isometric), isometric, assumption)
    group = np.where(isometric, 0, np.cumsum(~isometric))
    if isometric.all():
        return shape, Ambiguity(group, isometric, "all views are isometric to another one")
    return shape, Ambiguity(group, isometric, "the conformal factor varies least")


def isometric_views(shape: Shape, image: np.ndarray, declared: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Views that are isometric to another one for exactly one choice of inversions.

    Returns:
        (F,) bool, which views to invert for it, and (F,) bool, which views are isometric to another one.
    """
    F = len(shape.log_factor)
    other = inverted(shape, image, np.ones(F, dtype=bool)).log_factor
    factor = np.stack([shape.log_factor, other], axis=1)
    spread = np.array([[_spreads(factor[a], factor[b]) for b in range(F)] for a in range(F)])
    flip, decided = np.zeros(F, dtype=bool), declared.copy()
    if declared.any():
        first = int(declared.argmax())
        options = spread[first][declared]  # (N, 2, 2): inversion of the first view, inversion of each
        own = int(options.min(axis=2).sum(axis=0).argmin())
        flip[declared] = options[:, own].argmin(axis=1)
        flip[first] = own
    pairs = []
    for a in range(F):
        for b in range(a):
            least, second = np.sort(spread[a, b].ravel())[:2]
            if least < _ISOMETRIC and second > _MARGIN * least:
                pairs.append((float(least), a, b, *divmod(int(spread[a, b].argmin()), 2)))
    for _, a, b, *wanted_inverse in sorted(pairs):
        for view, wanted in zip((a, b), wanted_inverse, strict=True):
            if not decided[view]:
                flip[view], decided[view] = bool(wanted), True
    return flip, decided


def _spreads(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(2, 2) standard deviations of the difference of two views' factors, each (2, P): as they are and inverted."""
    return np.asarray((a[:, None] - b[None]).std(axis=-1))


@dataclass(frozen=True)
class Consensus:
    """What the correlations of the views' forms say."""

    sign: np.ndarray
    """(F,) 1.0 or -1.0, with which the views agree best."""
    agreement: float
    """How far they then agree; 1 where all pairs do."""
    margin: np.ndarray
    """(F,) mean correlation of each view with the others, signs applied."""
    same_form: bool
    """Whether there is one form common to all views. Else signs may agree by chance, as bends about two axes do."""


def consensus(correlation: np.ndarray) -> Consensus:
    """Signs that make the views agree best, from the correlations (F, F) of their forms."""
    F = len(correlation)
    between = correlation - np.diag(np.diag(correlation))
    sign = np.where(np.linalg.eigh(between)[1][:, -1] >= 0.0, 1.0, -1.0)
    signed = between * np.outer(sign, sign)
    sum_of_sizes = max(float(np.abs(between).sum()), 1e-300)
    least, unexplained = _SAME_FORM
    others = ~np.eye(F, dtype=bool)
    return Consensus(
        sign=sign,
        agreement=float(signed.sum()) / sum_of_sizes,
        margin=signed.sum(axis=1) / max(F - 1, 1),
        same_form=bool((signed[others] >= least).all()) or (F >= _MANY and _unexplained(between) <= unexplained),
    )


def _unexplained(between: np.ndarray) -> float:
    """Root mean square of what no product of one number per view explains of correlations (F, F), relative to them."""
    loading = np.zeros(len(between))
    for _ in range(_FACTOR_STEPS):
        value, vector = np.linalg.eigh(between + np.diag(np.minimum(loading**2, 1.0)))
        loading = vector[:, -1] * np.sqrt(max(value[-1], 0.0))
    product = np.outer(loading, loading)
    np.fill_diagonal(product, 0.0)
    return float(np.linalg.norm(between - product)) / max(float(np.linalg.norm(between)), 1e-300)


def shear_correlation(points: np.ndarray, mesh: Mesh) -> np.ndarray:
    """(F, F) correlations of the views' trace-free second fundamental forms over the edges of the mesh.

    The two-ring is part of it: curvatures from near neighbours alone drown in little noise.
    """
    shear = np.empty((len(points), len(mesh.edges), 2))
    over_views(shear_kernel, len(points), np.ascontiguousarray(points), mesh.triangles, mesh.edges, shear)
    flat = shear.reshape(len(points), -1)
    flat /= np.maximum(np.median(np.abs(flat), axis=1, keepdims=True), 1e-300)
    flat = np.clip(flat, -_CLIP, _CLIP)
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-300)
    return flat @ flat.T
