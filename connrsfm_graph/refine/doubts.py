"""What a fit leaves in doubt, in sentences for those who will use it."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from connrsfm_graph.refine.settle import BEYOND_DOUBT, IN_COMMON
from connrsfm_graph.refine.slant import MOVED
from connrsfm_graph.refine.task import Fit

_OPEN = 0.2
"""Part of their relief by which the weakest prior on slants must move surfaces for these to rest on assumptions."""


def doubts(found: Fit, seen: np.ndarray) -> Iterator[str]:
    """One sentence for each assumption that decides about surfaces, or that the data contradict.

    Args:
        found: the fit that is taken.
        seen: (F, P) bool.
    """
    if found.ambiguity is not None and found.ambiguity.group.any():
        yield (
            f"views {np.flatnonzero(found.ambiguity.group).tolist()} may be inverted about the camera centre (of an "
            "orthographic camera: mirrored in depth): the tracks cannot tell, "
            f"the choice rests on the assumption that {found.ambiguity.assumption}"
        )
    if found.conformal or found.misfit() < BEYOND_DOUBT:
        return
    in_common, chance = found.corrections_in_common(seen)
    if in_common - chance > IN_COMMON:
        yield (
            f"corrections of neighbouring tracks have {in_common:.0%} of their variance in common: the surface does "
            "not keep its lengths, or the calibration is not right, and depths are less certain than is stated"
        )
    if found.evidence.get(MOVED, 0.0) > _OPEN:
        yield (
            "tracks tell little about slants, as where a surface hardly bends before a camera that hardly moves: all "
            "images may lean or bulge too much or too little alike"
        )
