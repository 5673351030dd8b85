"""How well a fit predicts image points that it was not given.

With strong image noise the size of a fit's residuals does not say how far lengths are to be trusted: ray corrections
take over what lengths may not explain. Points left out tell: lengths trusted too far pass the noise on to the
neighbours' points, lengths trusted too little pass nothing on.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from connrsfm_graph.refine.measurements import Measurements, Shape
from connrsfm_graph.refine.solve import minimise

_PARTS, _USED, _ENOUGH = 5, 3, 1000
"""Observations are dealt out at random to so many parts, of which so many are left out in turn, fewer if those hold
enough observations."""
_LEFT_OUT = 1e-2
"""Factor on the weight of an image point that is left out: enough to keep it where nothing else holds it."""
_ITERATIONS = 8
"""Of every fit, the same number for all that are compared. They are close ones: a fit that has not yet forgotten a
point predicts it too well, and the better the tighter its lengths are held."""
_SIGNIFICANT = 2.0
"""Standard errors by which the errors' mean must differ."""
_GROSS = 9.0
"""Squared errors count up to this many times their median: wrong tracks predict nothing."""


def prediction_errors(measurements: Measurements, shape: Shape, seen: np.ndarray) -> np.ndarray:
    """(N,) squared distances of image points from where the fit to the others puts them.

    Args:
        measurements: what was fitted.
        shape: the fit to all points.
        seen: (F, P) bool; points are the same for the same array.
    """
    part = np.where(seen, np.random.default_rng(0).integers(_PARTS, size=seen.shape), _PARTS)
    errors = []
    for number in range(_USED):
        left_out = part == number
        weight = np.where(left_out, _LEFT_OUT, 1.0) * measurements.image_weight
        fitted, _ = minimise(replace(measurements, image_weight=weight), shape, _ITERATIONS, 0.0, closely=True)
        errors.append((fitted.correction[left_out] ** 2).sum(axis=-1))
        if sum(map(len, errors)) >= _ENOUGH:
            break
    return np.concatenate(errors)


def gain(errors: np.ndarray, than: np.ndarray) -> tuple[float, float]:
    """Mean by which squared errors (N,) are smaller than others at the same points, and its standard error."""
    if len(errors) < 2:
        return 0.0, 0.0
    most = _GROSS * float(np.median(than))
    difference = np.minimum(than, most) - np.minimum(errors, most)
    return float(difference.mean()), float(difference.std()) / float(np.sqrt(len(difference)))


def predicts_better(errors: np.ndarray, than: np.ndarray) -> bool:
    """Whether squared errors (N,) of one fit are significantly smaller than those of another at the same points."""
    mean, deviation = gain(errors, than)
    return mean > _SIGNIFICANT * deviation
