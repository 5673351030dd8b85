"""A graph that grows view by view, and which of its factors touch a variable."""

from __future__ import annotations

import gtsam
import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.slam.window import camera_keys, is_camera
from factors.keys import LOG_DEPTH, MAP_POINT, decode, describe


class GrowingGraph:
    """Factors on cameras and variables of the user, but none on the map."""

    def __init__(self) -> None:
        self.graph = gtsam.NonlinearFactorGraph()
        self._touching: dict[int, list[int]] = {}  # indices in the graph of the factors on a variable

    def append(self, new: gtsam.NonlinearFactorGraph) -> None:
        """Take in the factors of the next view."""
        for n in range(new.size()):
            for k in new.at(n).keys():
                self._touching.setdefault(k, []).append(self.graph.size() + n)
        self.graph.push_back(new)

    def around(
        self, first: int, number: int, new: gtsam.NonlinearFactorGraph, recent: int
    ) -> gtsam.NonlinearFactorGraph:
        """The factors on some views, and all others on the variables of the user in these.

        Args:
            first, number: the views from the one to the other, the newest.
            new: factors of the newest, not yet taken in.
            recent: the others only where their last view is not before this one: a landmark may be old.
        """
        direct = self._found({k for n in range(first, number + 1) for k in camera_keys(n)})
        factors = [self.graph.at(n) for n in sorted(direct)] + [new.at(n) for n in range(new.size())]
        others = {k for factor in factors for k in factor.keys() if not is_camera(k)}
        indirect = [self.graph.at(n) for n in sorted(self._found(others) - direct)]
        graph = gtsam.NonlinearFactorGraph()
        for factor in [*factors, *(factor for factor in indirect if _last_view(factor, number) >= recent)]:
            graph.push_back(factor)
        return graph

    def _found(self, keys: set[int]) -> set[int]:
        return {n for k in keys for n in self._touching.get(k, [])}


def push_back(graph: gtsam.NonlinearFactorGraph, factors: gtsam.NonlinearFactorGraph) -> None:
    """Append factors to a graph, without the gaps that removed ones have left."""
    for n in range(factors.size()):
        if (factor := factors.at(n)) is not None:
            graph.push_back(factor)


def _last_view(factor: gtsam.NonlinearFactor, otherwise: int) -> int:
    return max((decode(k)[2] for k in factor.keys() if is_camera(k)), default=otherwise)


def try_out(graph: gtsam.NonlinearFactorGraph, new: gtsam.Values, values: gtsam.Values) -> None:
    """Evaluate new factors at the values they would meet, so that a fault is told by name.

    Args:
        graph: the new factors.
        new: the variables that come with them.
        values: all variables, the new ones included.

    Raises:
        InputError: a factor is on the map or on a variable without a value, cannot be evaluated or is not finite, or a
            new variable is in no factor.
    """
    needed = set(graph.keyVector())
    mapped = [k for k in needed if decode(k)[0] in (LOG_DEPTH, MAP_POINT)]
    if mapped:
        raise InputError(f"a factor is on {describe(mapped[0])}, expected none on the map while it grows")
    missing = [k for k in needed if not values.exists(k)]
    if missing:
        raise InputError(f"a factor asks for {describe(missing[0])}, which has no value")
    idle = [k for k in new.keys() if k not in needed and not is_camera(k)]
    if idle:
        raise InputError(f"{describe(idle[0])} is in no factor")
    try:
        graph.linearize(values)
        cost = graph.error(values)
    except Exception as error:  # whatever a user's factor throws
        told = str(error).strip().partition("\n")[0][:200]
        raise InputError(f"a factor cannot be evaluated ({type(error).__name__}: {told})") from error
    if not np.isfinite(cost):
        raise InputError("the cost of its factors is not a number")
