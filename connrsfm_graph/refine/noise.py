"""Noise levels of the refinement, and what a fit says about them.

Two levels are to be known, of image points and of lengths, and the sizes of a fit's residuals do not tell them apart:
what one may not explain the other takes over. What tells is whether the ray corrections look like noise. Noise is
independent from point to point; a surface that stretches, or a warp's misfit taken for noise, moves neighbours alike.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from connrsfm_graph.refine.mesh import Mesh

_LEAST_IMAGE = 1e-4
"""Smallest image noise, relative to the median image length of a mesh edge."""
_OVERESTIMATED = 0.7
"""Corrections below this part of the assumed image noise show that it was assumed too large."""
_SURE = 0.25
"""Part of the first estimate of the image noise below which it is never lowered: corrections shrink with the noise that
is assumed, so they alone would take it to nothing."""
_HUBER = (0.25, 2.0, 1.0)
"""Robust threshold of the length residuals: at least, in units of their own robust standard deviation, at most."""
_PRIOR = 8.0
"""For the shared log lengths, before the views have shown how well they agree about them."""
_RELEASE = 10.0
"""After the first fit an interpolated image point is held by so much less than its uncertainty says."""
_DIFFERS = (3.0, 0.01)
"""Edges count as loose whose lengths differ from view to view by so many times more than the median edge's do, and by
so much in logarithms. The view in which an edge differs most is left out."""
_SETTLED = 0.1
_GROSS = (5.0, 0.1)
"""A track is wrong beyond so many standard deviations, and this part of an edge's median image length."""
_RAYLEIGH = 1.1774
"""Median of the norm of a plane Gaussian vector of unit standard deviation."""


@dataclass(frozen=True)
class Noise:
    """What a fit assumes."""

    image: float
    """Standard deviation of a coordinate of the image points, normalised coordinates."""
    length: float
    """Standard deviation of a log length in one view."""
    spacing: float
    """Median image length of a mesh edge."""
    least: float
    """Smallest image noise that may be assumed."""
    prior: float = _PRIOR
    """Inverse standard deviation of the shared log lengths about their start, in an isometric model."""
    huber: float = _HUBER[2]
    """Length residuals count linearly beyond so many standard deviations."""
    patches: int = 0
    """Independent patches of the surface in a view, of which each is more likely seen frontally (see
    `factors.frontal`)."""
    release: float = 1.0
    """Factor on the uncertainty of interpolated image points."""
    turns: bool = False
    """Whether short edges are turned by noise of their ends, and loosened."""
    looseness: np.ndarray = field(default_factory=lambda: np.ones(1), compare=False)
    """(E,) by what factor the length noise of an edge is larger: one that crosses a tear keeps no length. (1,) before a
    fit has shown it."""

    @staticmethod
    def start(image: float, length: float, spacing: float) -> Noise:
        """For an estimate of the image noise, NaN where there is none."""
        image = max(image if np.isfinite(image) else 0.0, _LEAST_IMAGE * spacing)
        return Noise(image, length, spacing, max(_SURE * image, _LEAST_IMAGE * spacing))

    def image_weight(self, seen: np.ndarray, deviation: np.ndarray) -> np.ndarray:
        """(F, P) inverse standard deviations of seen and interpolated image points."""
        return 1.0 / np.where(seen, self.image, np.maximum(self.image, self.release * deviation))

    def lowered_image(self, correction: np.ndarray) -> Noise:
        """With the image noise that ray corrections (N, 2) show, where it was assumed too large.

        It is only ever lowered: the estimate given is an upper bound, since a warp's misfit is not all noise.
        """
        shown = float(np.sqrt((correction**2).mean()))
        if shown >= _OVERESTIMATED * self.image:
            return self
        return replace(self, image=max(shown, self.least))

    def tighter(self, times: float) -> Noise:
        """With so many times less length noise."""
        return replace(self, length=self.length / times)

    def after_fit(self, residual: np.ndarray, seen: np.ndarray) -> Noise:
        """With the robust threshold and the loose edges that length residuals show, and interpolated points released.

        Where residuals are smaller than was assumed, so is all that the lengths' prior may add to the cost. Edges are
        loosened as by the robust loss of Geman and McClure, all views of one together: what tears is the surface.

        Args:
            residual: (F, E) length residuals.
            seen: (F, E) bool, of observed points.
        """
        least, factor, most = _HUBER
        shown = 1.4826 * float(np.median(np.abs(residual))) / self.length
        huber = float(np.clip(factor * shown, least, most))
        views, (times, at_least) = seen.sum(axis=0), _DIFFERS
        square = np.where(seen, residual, 0.0) ** 2
        square = (square.sum(axis=0) - square.max(axis=0)) / np.maximum(views - 1, 1)  # one wrong track is no tear
        usual = float(np.median(square[views > 1])) if (views > 1).any() else 0.0
        looseness = 1.0 + square / max(times**2 * usual, at_least**2)
        return replace(self, huber=huber, prior=_PRIOR * min(1.0, shown), release=_RELEASE, looseness=looseness)

    def settled(self, last: Noise) -> bool:
        """Whether another fit would change little."""
        return (
            self.release == last.release
            and abs(self.image - last.image) <= _SETTLED * last.image
            and abs(self.huber - last.huber) <= _SETTLED * last.huber
            and float(np.abs(self.looseness**-2.0 - last.looseness**-2.0).max()) <= _SETTLED
        )

    def gross(self, size: np.ndarray) -> float:
        """Length beyond which a ray correction means a wrong track, from the lengths (N,) of all."""
        return max(_GROSS[0] * float(np.median(size)) / _RAYLEIGH, _GROSS[1] * self.spacing)


def neighbour_correlation(correction: np.ndarray, seen: np.ndarray, mesh: Mesh) -> tuple[float, float]:
    """Correlation of ray corrections (F, P, 2) of seen neighbours, and its standard error if they are independent."""
    a, b = mesh.edges[: mesh.n_near].T
    both = seen[:, a] & seen[:, b]
    if not both.any():
        return 0.0, 1.0
    product = (correction[:, a] * correction[:, b])[both]
    variance = float((correction[seen] ** 2).mean())
    return float(product.mean()) / max(variance, 1e-300), 1.0 / float(np.sqrt(product.size))
