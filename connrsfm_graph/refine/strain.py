"""Views that are pulled as a whole along one direction: isometric but for a homogeneous strain of each view.

Cloth under tension and rubber stretch more along one direction than along the other, and by so much that lengths
cannot be shared: taken for isometric, a pull looks like a tilt. Two numbers for each view explain it (see
`factors.edge_length.stretch_kernel`), so few that the shared lengths and the perspective tell them from a tilt. Strains
that vary over the surface are left to the noise of the lengths.

Directions on the surface are at first those in the image that the mesh was made in, then those of the surface laid out
flat.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from connrsfm_graph.refine.caught import reseated_where_dear, restarted_where_dear
from connrsfm_graph.refine.flatten import flattened
from connrsfm_graph.refine.held_out import errors_of, part_gained
from connrsfm_graph.refine.measurements import Shape
from connrsfm_graph.refine.noise import Noise
from connrsfm_graph.refine.settle import BEYOND_DOUBT, settled
from connrsfm_graph.refine.start import log_chords, start_shape
from connrsfm_graph.refine.task import Fit, Task, minimised
from connrsfm_graph.threads import mapped

_CHEAPER, _HOPE = 1.1, 0.1
"""A search for strains is worth it where a first fit with them lowers the cost by this factor, which they always do a
little, and the squared errors of points left out by more than this part."""
_PART, _SURE = 1.0 / 6.0, 3.0
"""Taken are strains with which points left out are predicted better by this part, and so many standard errors."""
_PULLED = (0.0, 0.5)
"""Parts of what distinguishes the images of flat views that are taken for pulls at the start."""
_ROUNDS = 4
"""So often surfaces are laid out flat by what was found, at most."""
_WORTH = 0.9
"""As long as that lowers the cost to this part."""


def stretched(task: Task, found: Fit, noise: Noise) -> tuple[Task, Fit]:
    """A settled isometric fit, or that of views with a homogeneous strain where it predicts points left out far better.

    Strains are tried where ray corrections do not look like noise, and are searched for to the end where already a
    first fit with them promises something. Where the search comes upon a better isometric fit, that one is gone on
    with. Costs do not decide: strains lower them on cloth that waves, too, and tilt it.

    Args:
        task: what is to be fitted.
        found: the settled isometric fit.
        noise: the noise levels under which its first cost was.

    Returns:
        The task, of strained views with a mesh that is laid out flat, and the fit.
    """
    wanted = task.config.stretched
    if wanted == "no" or (wanted == "auto" and (found.noisy or found.misfit() < BEYOND_DOUBT)):
        return task, found
    own, best = task, _cheapest(task, replace(found, noise=noise))
    if wanted == "auto" and not _promising(task, found, best):
        return task, found
    best = _not_caught(task, best)
    for _ in range(_ROUNDS):
        mesh, completed = flattened(task.mesh, best.shape.log_length), task.completed
        again = replace(task, mesh=mesh, completed=replace(completed, log_depth=best.shape.log_depth))
        trial = _not_caught(again, _cheapest(again, best)) if own is task else _minimum(again, best, best.shape)
        if trial.first_cost > _WORTH * best.first_cost:
            break
        own, best = again, trial
    isometric = _minimum(own, best, replace(best.shape, strain=best.shape.strain[:, :0]))
    found.evidence["isometric over stretched cost"] = isometric.first_cost / max(best.first_cost, 1e-300)
    strained = settled(own, best)
    if wanted == "auto":
        other = _minimum(task, isometric, isometric.shape)
        if other.first_cost < found.first_cost:
            found = settled(task, other)
        part, deviation = _predicted_better(task, found, strained)
        if part <= max(_PART, _SURE * deviation):
            return task, found
    strained.evidence["strain of views"] = strained.shape.strain.tolist()
    return own, strained


def _promising(task: Task, found: Fit, strained: Fit) -> bool:
    """Whether a first fit with strains is worth a search for the best one."""
    found.evidence["isometric over stretched cost"] = found.first_cost / max(strained.first_cost, 1e-300)
    if found.first_cost < _CHEAPER * strained.first_cost:
        return False
    part, _ = _predicted_better(task, found, _minimum(task, found, strained.shape))
    return part > _HOPE


def _predicted_better(task: Task, found: Fit, strained: Fit) -> tuple[float, float]:
    """By what part strains lower the squared errors of points left out, and its standard error."""
    without, with_strains = errors_of((found, strained), task.seen)
    part, deviation = part_gained(with_strains, without)
    found.evidence["part by which strains lower squared errors of points left out"] = part
    return part, deviation


def _cheapest(task: Task, found: Fit) -> Fit:
    """The cheapest of the fits with strains from several starts."""
    return min(mapped(lambda start: _minimum(task, found, start), _starts(task, found)), key=lambda fit: fit.first_cost)


def _not_caught(task: Task, found: Fit) -> Fit:
    """The fit, views that are caught in a wrong shape started again."""
    return reseated_where_dear(task, restarted_where_dear(task, found, lend=True))


def _minimum(task: Task, found: Fit, start: Shape) -> Fit:
    """A fit from another start, under the noise levels of one that was found."""
    measurements = task.measurements(found.noise, conformal=False)
    shape, history = minimised(task, measurements, start)
    return replace(
        found, measurements=measurements, shape=shape, history=found.history + history, first_cost=history[-1]
    )


def _starts(task: Task, found: Fit) -> Iterator[Shape]:
    """The fit; and, since one that takes pulls for tilts may be far off, flat views that are pulled more or less."""
    F, E = len(found.shape.log_depth), len(task.mesh.edges)
    none = np.zeros((F, 2))
    yield found.shape if found.shape.strain.size else replace(found.shape, strain=none)
    flat = task.flat().completed
    shape = start_shape(flat, task.mesh)
    residual = log_chords(shape.points(flat.image), task.mesh.edges) - shape.log_length
    rows = np.concatenate([task.mesh.direction, np.ones((E, 1))], axis=1)
    pull = (residual @ np.linalg.pinv(rows).T)[:, :2]
    for part in _PULLED:
        yield replace(shape, strain=part * (pull - pull.mean(axis=0)))
