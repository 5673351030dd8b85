"""How well a fit predicts image points that it was not given.

With strong image noise the size of a fit's residuals does not say how far lengths are to be trusted: ray corrections
take over what lengths may not explain. Points left out tell: lengths trusted too far pass the noise on to the
neighbours' points, lengths trusted too little pass nothing on.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from connrsfm_graph.refine.measurements import Measurements, Shape
from connrsfm_graph.refine.solve import minimise
from connrsfm_graph.refine.task import Fit
from connrsfm_graph.threads import mapped

_PARTS, _USED, _ENOUGH = 5, 3, 1000
"""Observations are dealt out at random to so many parts, of which so many are left out in turn, fewer if those hold
enough observations."""
_LEFT_OUT = 1e-2
"""Factor on the weight of an image point that is left out: enough to keep it where nothing else holds it."""
_ITERATIONS, _TOLERANCE = 24, 1e-4
"""At most so many of each fit, and its tolerance. They are close ones: what has not yet forgotten a point
predicts it too well, and the more so the tighter its lengths are held."""
_GROSS = 9.0
"""Squared errors count up to this many times their median: wrong tracks predict nothing."""


class HeldOut:
    """Fits that are each without a part of the observations, and what they predict of it.

    Fits under other weights go on from the last ones, which have forgotten the points that are left out.
    """

    def __init__(self, shape: Shape, seen: np.ndarray):
        """Deal the observations out.

        Args:
            shape: a fit to all points, near those that will be.
            seen: (F, P) bool; points are the same for the same array.
        """
        self._part = np.where(seen, np.random.default_rng(0).integers(_PARTS, size=seen.shape), _PARTS)
        size = np.cumsum([np.count_nonzero(self._part == number) for number in range(_USED)])
        self._fits = [shape] * min(_USED, 1 + int(np.searchsorted(size, _ENOUGH)))

    def errors(self, measurements: Measurements) -> np.ndarray:
        """(N,) squared distances of image points from where the fit to the others puts them."""

        def without(number: int) -> Shape:
            weight = np.where(self._part == number, _LEFT_OUT, 1.0) * measurements.image_weight
            others = replace(measurements, image_weight=weight)
            return minimise(others, self._fits[number], _ITERATIONS, _TOLERANCE, closely=True)[0]

        self._fits = list(mapped(without, range(len(self._fits))))
        left_out = (fit.correction[self._part == number] for number, fit in enumerate(self._fits))
        return np.concatenate([(correction**2).sum(axis=-1) for correction in left_out])


def errors_of(fits: Iterable[Fit], seen: np.ndarray) -> list[np.ndarray]:
    """(N,) squared distances at the same points for each of some fits; see `HeldOut`."""
    return list(mapped(lambda fit: HeldOut(fit.shape, seen).errors(fit.measurements), fits))


def gain(errors: np.ndarray, than: np.ndarray) -> tuple[float, float]:
    """Mean by which squared errors (N,) are smaller than others at the same points, and its standard error."""
    if len(errors) == 0:
        return 0.0, 0.0
    difference = _capped(than, than) - _capped(errors, than)
    return float(difference.mean()), float(difference.std()) / float(np.sqrt(len(difference)))


def part_gained(errors: np.ndarray, than: np.ndarray) -> tuple[float, float]:
    """By what part of others at the same points squared errors (N,) are smaller, and its standard error."""
    usual = max(float(_capped(than, than).mean()), 1e-300) if len(than) else 1.0
    better_by, deviation = gain(errors, than)
    return better_by / usual, deviation / usual


def within(deviations: float, errors: np.ndarray, best: np.ndarray) -> bool:
    """Whether squared errors (N,) are larger than the best by at most so many standard errors of the difference."""
    better_by, deviation = gain(errors, best)
    return better_by >= -deviations * deviation


def _capped(errors: np.ndarray, than: np.ndarray) -> np.ndarray:
    """Squared errors as they count where they are compared with others."""
    return np.minimum(errors, _GROSS * float(np.median(than)))
