"""Which views of a conformal reconstruction might as well be inverted about the camera centre, and which not.

The inversion X -> X / |X|^2 keeps all sight rays and is conformal: no residual of images and lengths changes. So every
view of a purely conformal reconstruction is known up to one inversion. What decides, in this order:

1. Isometry. Two views, declared or found to be isometric, have equal conformal factors up to a constant; inverting
   one or both spoils that (unless they are seen from the same place).
2. The trace-free second fundamental form. Where the surface deforms like a piece of space under Moebius maps, it is
   the same in all views up to scale, and inverting a view turns its sign. If all pairs of views agree in that, all
   views are decided but for one common inversion.
3. The least variation of the conformal factor: a convention rather than knowledge. What only this has decided is
   reported as ambiguous.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from connrsfm_graph.refine.curvature import shear_kernel
from connrsfm_graph.refine.mesh import Mesh
from connrsfm_graph.refine.restarts import inverted
from connrsfm_graph.refine.solve import Shape
from connrsfm_graph.threads import over_views

_ISOMETRIC = 0.005
"""Two views are isometric where the standard deviation of their difference in log conformal factor is below this."""
_MARGIN = 5.0
"""It must be larger by this factor for any other choice of inversions of the two."""
_AGREEMENT = 0.5
"""Least correlation of the trace-free second fundamental forms of any two views that counts as agreement."""
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
    correlation = shear_correlation(shape.points(image), mesh)
    sign = np.sign(correlation[int(isometric.argmax())])
    sign[sign == 0] = 1.0
    if (correlation * np.outer(sign, sign) >= _AGREEMENT).all() and len(sign) > 1 and (sign[isometric] > 0).all():
        # Without a decided view the majority stays as it is.
        if not isometric.any() and (sign > 0).sum() < len(sign) / 2:
            sign = -sign
        shape = inverted(shape, image, sign < 0)
        group = np.full(len(sign), 0 if isometric.any() else 1)
        return shape, Ambiguity(group, isometric, "the trace-free second fundamental form is kept up to scale")
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


def shear_correlation(points: np.ndarray, mesh: Mesh) -> np.ndarray:
    """(F, F) correlations of the views' trace-free second fundamental forms over the near edges of the mesh."""
    near = mesh.edges[: mesh.n_near]
    shear = np.empty((len(points), len(near), 2))
    over_views(shear_kernel, len(points), np.ascontiguousarray(points), mesh.triangles, near, shear)
    flat = shear.reshape(len(points), -1)
    flat /= np.maximum(np.median(np.abs(flat), axis=1, keepdims=True), 1e-300)
    flat = np.clip(flat, -_CLIP, _CLIP)
    flat /= np.maximum(np.linalg.norm(flat, axis=1, keepdims=True), 1e-300)
    return flat @ flat.T
