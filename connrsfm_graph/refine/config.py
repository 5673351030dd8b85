"""Settings of the refinement."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

from connrsfm_graph.errors import InputError

Model = Literal["auto", "isometric", "conformal"]
Stretched = Literal["auto", "yes", "no"]


@dataclass(frozen=True)
class RefineConfig:
    """Refinement over latent edge lengths shared by all views."""

    model: Model = "auto"
    """What the views' surfaces share: `isometric` their edge lengths, `conformal` the lengths' ratios; `auto` takes the
    conformal model only where isometry misses the data by more than its assumed noise and conformality does not."""
    isometric_views: tuple[int, ...] = ()
    """Views known to be isometric to each other (at least two), for the conformal model: their common metric fixes what
    conformal invariance alone cannot tell."""
    length_sigma: float = 0.01
    """Standard deviation of a log edge length in one view: what the surface stretches, and the mesh does not show.
    Where the tracks are noisy it is where a smaller one is looked for, as far as that predicts points left out."""
    factor_sigma: float = 0.2
    """Standard deviation of the difference of log conformal factor between neighbours, for the conformal model."""
    stretched: Stretched = "auto"
    """Whether, in the isometric model, each view may also be pulled as a whole along one direction: `yes`, `no`, or
    `auto`, where isometry misses the data and points left out are predicted far better with it."""
    strain_sigma: float = 0.2
    """Standard deviation of the two numbers of such a pull, a homogeneous strain."""
    rings: int = 2
    """Edges join points up to this distance in the triangulation, 1 or 2."""
    outliers: bool = True
    """Whether wrong tracks are looked for and replaced by what the other points and views say."""
    bending: bool = False
    """Whether surfaces are kept from bending. Shared lengths alone already keep noise from crumpling a surface."""
    bending_sigma: float = 8.0
    """Standard deviation of the hinges' curvature vectors relative to their size."""
    frontal_patches: tuple[int, ...] = (30, 100)
    """Of how many independent patches in a view a surface may be taken to consist, each more likely seen frontally than
    not, rising: how many the data say, by points left out. For the isometric model; empty for none."""
    uncertainty: bool = True
    """Whether the standard deviations of the depths are computed."""
    iterations: int = 30
    """Iterations of the joint solver at most, in each of its runs."""
    tolerance: float = 1e-3
    """The solver stops where an iteration lowers the cost by less than this part."""

    def __post_init__(self) -> None:
        if self.model not in get_args(Model):
            raise InputError(f"refine.model is '{self.model}', expected one of {', '.join(get_args(Model))}")
        if self.stretched not in get_args(Stretched):
            raise InputError(
                f"refine.stretched is '{self.stretched}', expected one of {', '.join(get_args(Stretched))}"
            )
        for name in ("length_sigma", "factor_sigma", "strain_sigma", "bending_sigma"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise InputError(f"refine.{name} is {getattr(self, name)}, expected a positive number")
        if self.rings not in (1, 2):
            raise InputError(f"refine.rings is {self.rings}, expected 1 or 2")
        patches = self.frontal_patches
        if any(a >= b for a, b in zip((0, *patches), patches, strict=False)):
            raise InputError(f"refine.frontal_patches is {list(patches)}, expected positive numbers that rise")
        if self.iterations < 1:
            raise InputError(f"refine.iterations is {self.iterations}, expected at least 1")
        if not 0.0 <= self.tolerance < 1.0:
            raise InputError(f"refine.tolerance is {self.tolerance}, expected 0 or more, below 1")
        if len(self.isometric_views) == 1:
            raise InputError("refine.isometric_views names one view, expected none or at least two")
