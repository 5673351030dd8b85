"""Gross errors of the tracks, found in the images alone.

Between two views the surroundings of a point move nearly affinely. An observation is judged by where its neighbours
say it should be: predicted from several other views by affine maps that are robust against wrong neighbours, in units
of how well the neighbours themselves fit. A wrong track disagrees with every other view, a right one only with views
in which the same track is wrong. Judging once more without the wrong ones finds those that hid behind others.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

_NEIGHBOURS = 12
"""Points from which a position is predicted, at most; at least half as many."""
_SOURCES = 9
"""Other views from which it is predicted, at most."""
_REWEIGHTINGS = 6
"""Iterations of the least absolute deviations fit."""
_CUT = 5.0
"""Disagreement of a wrong track, in units of the neighbours' median error; of 20,000 right ones two exceed it."""
_ROUNDS = 4


def wrong_tracks(image: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """(F, P) bool, the observation is judged wrong.

    Args:
        image: (F, P, 2) image points, any value where not visible.
        visible: (F, P) bool.
    """
    image = np.where(visible[..., None], image, 0.0)
    wrong = np.zeros_like(visible)
    for _ in range(_ROUNDS):
        last, wrong = wrong, visible & (disagreement(image, visible, visible & ~wrong) > _CUT)
        if (wrong == last).all():
            break
    return wrong


def disagreement(image: np.ndarray, visible: np.ndarray, trusted: np.ndarray) -> np.ndarray:
    """(F, P) median over other views of the prediction error by its expected size; 0 where it cannot be judged.

    Args:
        image: (F, P, 2) finite image points.
        visible: (F, P) bool, observations to judge.
        trusted: (F, P) bool, observations to judge by.
    """
    F, P = visible.shape
    score = np.zeros((F, P))
    for f in range(F):
        shared = (trusted & trusted[f]).sum(axis=1)
        shared[f] = 0
        order = np.argsort(-shared, kind="stable")
        order = order[shared[order] > _NEIGHBOURS // 2]
        ratios: list[np.ndarray] = []
        for g in order[np.unique(np.linspace(0, len(order) - 1, min(len(order), _SOURCES)).astype(int))]:
            ratio = np.full(P, np.nan)
            judged = np.flatnonzero(visible[f] & trusted[g])
            base = np.flatnonzero(trusted[f] & trusted[g])
            ratio[judged] = _prediction_error(image[g], image[f], judged, base)
            ratios.append(ratio)
        if ratios:
            table = np.stack(ratios)
            known = np.isfinite(table).any(axis=0)
            score[f, known] = np.nanmedian(table[:, known], axis=0)
    return score


def _prediction_error(source: np.ndarray, target: np.ndarray, judged: np.ndarray, base: np.ndarray) -> np.ndarray:
    """Errors of the robust affine predictions of points in `target` over their expected sizes.

    Args:
        source, target: (P, 2) images.
        judged: (N,) points to predict.
        base: (M,) points to predict from; a point does not predict itself.
    """
    m = min(_NEIGHBOURS, len(base) - 1)
    near = base[cKDTree(source[base]).query(source[judged], k=m + 1)[1]]
    # The point itself, where it is among its neighbours, goes to the end and is cut off.
    near = np.take_along_axis(near, np.argsort(near == judged[:, None], axis=1, kind="stable"), axis=1)[:, :m]
    offset = source[near] - source[judged, None]
    offset /= np.sqrt((offset**2).sum(axis=2).mean(axis=1))[:, None, None] + 1e-300
    A = np.concatenate([np.ones_like(offset[..., :1]), offset], axis=2)
    b = target[near] - target[judged, None]
    weight = np.ones(near.shape)
    for _ in range(_REWEIGHTINGS):
        WA = weight[..., None] * A
        ridge = 1e-9 * weight.sum(axis=1)[:, None, None] * np.eye(3)
        inverse = np.linalg.inv(np.swapaxes(WA, 1, 2) @ A + ridge)
        fit = inverse @ (np.swapaxes(WA, 1, 2) @ b)
        size = np.linalg.norm(b - A @ fit, axis=2)
        typical = np.median(size, axis=1)
        floor = 0.1 * typical[:, None] + 1e-12
        weight = floor / np.maximum(size, floor)
    # The point is the origin of A, so the prediction's variance over the noise is the first entry of the inverse.
    expected = typical * np.sqrt(1.0 + inverse[:, 0, 0]) + 1e-12
    return np.linalg.norm(fit[:, 0], axis=1) / expected
