"""Similarity alignment of a reconstruction to the truth (Umeyama, PAMI 1991)."""

from __future__ import annotations

import numpy as np

from connrsfm_graph.errors import InputError


def align_similarity(
    source: np.ndarray, target: np.ndarray, weight: np.ndarray | None = None
) -> tuple[float, np.ndarray, np.ndarray]:
    """Scale s, rotation R and translation t that minimise sum_i w_i |target_i - (s R source_i + t)|^2.

    R is a proper rotation: a mirrored source stays mirrored, so that a relief reversal counts as the error it is.

    Args:
        source, target: (P, 3) corresponding points, finite.
        weight: (P,) non-negative; equal weights where absent.

    Returns:
        s > 0, R (3, 3), t (3,).

    Raises:
        InputError: shapes differ, or fewer than three points carry weight.
    """
    source, target = np.asarray(source, dtype=float), np.asarray(target, dtype=float)
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3:
        raise InputError(f"alignment needs two (P, 3) arrays of equal shape, got {source.shape} and {target.shape}")
    w = np.ones(len(source)) if weight is None else np.asarray(weight, dtype=float)
    if np.count_nonzero(w) < 3:
        raise InputError(f"alignment needs at least 3 points, got {np.count_nonzero(w)}")
    w = w / w.sum()
    source_mean, target_mean = w @ source, w @ target
    source_centred, target_centred = source - source_mean, target - target_mean
    U, singular, Vt = np.linalg.svd((target_centred * w[:, None]).T @ source_centred)
    proper = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    R = (U * proper) @ Vt
    variance = w @ (source_centred**2).sum(axis=1)
    scale = float(singular @ proper / variance) if variance > 0 else 1.0
    return scale, R, target_mean - scale * R @ source_mean
