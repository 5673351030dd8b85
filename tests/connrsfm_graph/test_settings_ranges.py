"""Settings outside their range are refused in one sentence instead of hanging or crashing later."""

from __future__ import annotations

import pytest

from connrsfm_graph.config import override
from connrsfm_graph.errors import InputError
from connrsfm_graph.reconstruct import Config


@pytest.mark.parametrize(
    "assignment",
    [
        "solve.levenberg.damping=-1",
        "solve.levenberg.damping=inf",
        "solve.levenberg.max_iterations=-1",
        "solve.levenberg.tolerance=inf",
        "solve.outer_iterations=0",
        "solve.restarts=-1",
        "integrate.huber=0",
        "integrate.bending=inf",
        "integrate.control_points=0",
        "graph.extra_per_frame=inf",
        "graph.max_extra=-1",
        "graph.min_shared=0",
        "warps.padding=inf",
        "warps.schwarzian=inf",
        "warps.min_points=1",
        "refine.length_sigma=-1",
        "refine.rings=7",
        "refine.stretched=maybe",
        "refine.strain_sigma=0",
        "refine.frontal_patches=[0, 10]",
        "refine.frontal_patches=[30, 10]",
        "refine.length_sigma=inf",
        "refine.tolerance=inf",
        "refine.tolerance=nan",
        "refine.iterations=0",
        "graph.complete_up_to=-1",
        "solve.noise.metric=inf",
        "solve.noise.huber=nan",
        "solve.noise.intrinsic=-2",
        "seed=-1",
    ],
)
def test_out_of_range(assignment: str) -> None:
    name = assignment.split("=")[0].rsplit(".", 1)[-1]
    with pytest.raises(InputError, match=f"^--set .*{name}"):
        override(Config(), [assignment])
