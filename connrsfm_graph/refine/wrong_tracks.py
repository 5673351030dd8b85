"""Gross errors of the tracks, found in the images alone.

Between two views the surroundings of a point move nearly affinely. An observation is judged by where its neighbours
say it should be: predicted from several other views by affine maps that are robust against wrong neighbours, in units
of how well the neighbours themselves fit. A wrong track disagrees with every other view, a right one only with views
in which the same track is wrong. Judging once more without the wrong ones finds those that hid behind others.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from scipy.spatial import cKDTree

from connrsfm_graph.threads import mapped, over_views

_NEIGHBOURS = 12
"""Points from which a position is predicted, at most; at least half as many."""
_AT_HAND = 48
"""Nearest points of a view among which those seen in the other view are sought."""
_SOURCES = 9
"""Other views from which it is predicted, at most."""
_REWEIGHTINGS = 6
"""Iterations of the least absolute deviations fit."""
_CUT = 5.0
"""Disagreement of a wrong track, in units of the neighbours' median error; of 20,000 right ones two exceed it."""
_ROUNDS = 4
_AGREEING = 0.25
"""A track whose observations disagree with most other views everywhere keeps those that agree with so many."""


def wrong_tracks(
    image: np.ndarray, visible: np.ndarray, others: tuple[np.ndarray, np.ndarray] | None = None
) -> np.ndarray:
    """(F, P) bool, the observation is judged wrong.

    Args:
        image: (F, P, 2) image points, any value where not visible.
        visible: (F, P) bool.
        others: image points (G, P, 2) of the views to judge by, and which of them are trusted (G, P); where None, the
            views judge each other.
    """
    image = np.where(visible[..., None], image, 0.0)
    wrong = np.zeros_like(visible)
    for _ in range(_ROUNDS):
        trusted = visible & ~(wrong & ~_entirely(wrong, visible))
        last, wrong = wrong, visible & (disagreement(image, visible, trusted, others) > _CUT)
        if others is None and _entirely(wrong, visible).any():
            # Wrong in half of its views a track disagrees with most of them in all.
            least = disagreement(image, visible, trusted, others, _AGREEING)
            wrong &= (least > _CUT) | ~_entirely(wrong, visible)
        if (wrong == last).all():
            break
    return wrong


def _entirely(wrong: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """(P,) bool, tracks with nothing right in any view."""
    return np.asarray(visible.any(axis=0) & ~(visible & ~wrong).any(axis=0))


def disagreement(
    image: np.ndarray,
    visible: np.ndarray,
    trusted: np.ndarray,
    others: tuple[np.ndarray, np.ndarray] | None = None,
    share: float = 0.5,
) -> np.ndarray:
    """(F, P) median over other views of the prediction error by its expected size; 0 where it cannot be judged.

    Args:
        image: (F, P, 2) finite image points.
        visible: (F, P) bool, observations to judge.
        trusted: (F, P) bool, observations to judge by.
        others: as in `wrong_tracks`.
        share: of the views that predict as well as this; 0.5 for the median.
    """
    sources, source_trusted = (image, trusted) if others is None else others
    F, P = visible.shape
    chosen = np.full((F, _SOURCES), -1)
    for f in range(F):
        shared = (source_trusted & trusted[f]).sum(axis=1)
        if others is None:
            shared[f] = 0
        order = np.argsort(-shared, kind="stable")
        order = order[shared[order] > _NEIGHBOURS // 2]
        best = order[np.unique(np.linspace(0, len(order) - 1, min(len(order), _SOURCES)).astype(int))]
        chosen[f, : len(best)] = best
    near = np.full((len(sources), P, min(_AT_HAND, P)), -1)
    needed = np.unique(chosen[chosen >= 0])
    for g, found in zip(
        needed, mapped(lambda g: _nearest(sources[g], source_trusted[g], near.shape[2]), needed), strict=True
    ):
        near[g] = found
    score = np.zeros((F, P))
    # Arrays picked by columns may be stored by columns, for which everything would be compiled once more.
    arrays = (np.ascontiguousarray(array) for array in (image, visible, trusted, sources, source_trusted))
    over_views(_judge, F, *arrays, chosen, near, share, score)
    return score


def _nearest(points: np.ndarray, trusted: np.ndarray, count: int) -> np.ndarray:
    """(P, count) trusted points by their distance to each trusted point, itself left out; -1 where there are none."""
    base = np.flatnonzero(trusted)
    found = cKDTree(points[base]).query(points[base], k=min(count + 1, len(base)))[1].reshape(len(base), -1)
    # The point itself goes to the end, wherever it is among others at its place.
    order = np.argsort(found == np.arange(len(base))[:, None], axis=1, kind="stable")
    near = np.full((len(points), count), -1)
    kept = base[np.take_along_axis(found, order, axis=1)[:, : min(count, len(base) - 1)]]
    near[base, : kept.shape[1]] = kept
    return near


@njit(cache=True, nogil=True)
def _judge(first, last, image, visible, trusted, sources, source_trusted, chosen, near, share, score):
    """Disagreement of views first to last - 1 into `score` (F, P)."""
    P = visible.shape[1]
    ratios = np.empty(chosen.shape[1])
    neighbours = np.empty(_NEIGHBOURS, np.int64)
    for f in range(first, last):
        for i in range(P):
            if not visible[f, i]:
                continue
            known = 0
            for g in chosen[f]:
                if g < 0 or not source_trusted[g, i]:
                    continue
                count = 0
                for n in near[g, i]:
                    if n >= 0 and trusted[f, n] and count < _NEIGHBOURS:
                        neighbours[count] = n
                        count += 1
                if count >= _NEIGHBOURS // 2:
                    ratios[known] = _prediction_error(sources[g], image[f], i, neighbours[:count])
                    known += 1
            if known > 0:
                score[f, i] = np.quantile(ratios[:known], share)


@njit(cache=True, nogil=True)
def _prediction_error(source, target, i, near):
    """Error of the robust affine prediction of point i in `target` from its neighbours, over its expected size."""
    m = len(near)
    x, y, u, v = np.empty(m), np.empty(m), np.empty(m), np.empty(m)
    spread = 0.0
    for k in range(m):
        x[k], y[k] = source[near[k], 0] - source[i, 0], source[near[k], 1] - source[i, 1]
        u[k], v[k] = target[near[k], 0] - target[i, 0], target[near[k], 1] - target[i, 1]
        spread += x[k] * x[k] + y[k] * y[k]
    spread = np.sqrt(spread / m) + 1e-300
    weight, size = np.ones(m), np.empty(m)
    typical = leverage = at_u = at_v = 0.0
    for _ in range(_REWEIGHTINGS):
        # Normal equations of value and slopes; their inverse is that of a symmetric 3 x 3 matrix by cofactors.
        n00 = n01 = n02 = n11 = n12 = n22 = 0.0
        u0 = u1 = u2 = v0 = v1 = v2 = 0.0
        for k in range(m):
            w, a, b = weight[k], x[k] / spread, y[k] / spread
            n00 += w
            n01 += w * a
            n02 += w * b
            n11 += w * a * a
            n12 += w * a * b
            n22 += w * b * b
            u0 += w * u[k]
            u1 += w * a * u[k]
            u2 += w * b * u[k]
            v0 += w * v[k]
            v1 += w * a * v[k]
            v2 += w * b * v[k]
        ridge = 1e-9 * n00
        n00, n11, n22 = n00 + ridge, n11 + ridge, n22 + ridge
        c00, c01, c02 = n11 * n22 - n12 * n12, n02 * n12 - n01 * n22, n01 * n12 - n02 * n11
        c11, c12, c22 = n00 * n22 - n02 * n02, n01 * n02 - n00 * n12, n00 * n11 - n01 * n01
        determinant = n00 * c00 + n01 * c01 + n02 * c02
        leverage = c00 / determinant
        at_u, at_v = (c00 * u0 + c01 * u1 + c02 * u2) / determinant, (c00 * v0 + c01 * v1 + c02 * v2) / determinant
        ux, uy = (c01 * u0 + c11 * u1 + c12 * u2) / determinant, (c02 * u0 + c12 * u1 + c22 * u2) / determinant
        vx, vy = (c01 * v0 + c11 * v1 + c12 * v2) / determinant, (c02 * v0 + c12 * v1 + c22 * v2) / determinant
        for k in range(m):
            a, b = x[k] / spread, y[k] / spread
            size[k] = np.sqrt((u[k] - at_u - ux * a - uy * b) ** 2 + (v[k] - at_v - vx * a - vy * b) ** 2)
        typical = _median(size)
        floor = 0.1 * typical + 1e-12
        for k in range(m):
            weight[k] = floor / max(size[k], floor)
    # The point is the origin, so the prediction's variance over the noise is the first entry of the inverse.
    return np.sqrt(at_u * at_u + at_v * at_v) / (typical * np.sqrt(1.0 + max(leverage, 0.0)) + 1e-12)


@njit(cache=True, nogil=True)
def _median(values):
    """Median of a few values."""
    ordered = values.copy()
    for k in range(1, len(ordered)):
        value, at = ordered[k], k
        while at > 0 and ordered[at - 1] > value:
            ordered[at] = ordered[at - 1]
            at -= 1
        ordered[at] = value
    return 0.5 * (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2])
