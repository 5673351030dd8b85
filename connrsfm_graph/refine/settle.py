"""A fit under the noise levels that the data show."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from connrsfm_graph.refine.held_out import HeldOut, errors_of, gain, within
from connrsfm_graph.refine.noise import Noise
from connrsfm_graph.refine.task import Fit, Task, refitted, to_the_end
from connrsfm_graph.threads import mapped

BEYOND_DOUBT = 0.05
"""A fit that leaves less than this is right, whatever its ray corrections look like."""
IN_COMMON = 0.2
"""Part of their variance that neighbours' ray corrections have in common, beyond which they are not taken for noise."""
_ROUNDS = 4
"""Fits with noise levels that the one before has shown, at most."""
_LOOSE = 2.0
"""Edges of so many times the length noise of others are called loose."""
_REFUTED = 1.0
"""What predicts points left out worse than the best does, by more than so many standard errors, is refuted."""
_STEP = 4.0
"""Between levels of the length noise that are compared; in the end one is looked at that lies between two."""
_LEAST = 0.005
"""Below this part of what it was assumed to be at first it is not lowered again."""


def settled(task: Task, found: Fit) -> Fit:
    """The fit with the noise levels that the data show.

    Where the ray corrections look like noise, the image noise stands. Where neighbours' corrections have most in
    common, it was assumed too large. Where they have a little, which many points show to be more than chance, points
    left out decide: noise that hides a small misfit is noise still.
    """
    found = _as_noise_or_not(task, found)
    found.evidence.update(noise_evidence(task, found))
    return found


def _as_noise_or_not(task: Task, found: Fit) -> Fit:
    correlation, chance = found.corrections_in_common(task.seen)
    if correlation <= chance or correlation > IN_COMMON or found.conformal or found.misfit() < BEYOND_DOUBT:
        return _settled(task, found, noisy=correlation <= chance)
    lowered, standing = mapped(lambda noisy: _settled(task, found, noisy), (False, True))
    without, errors = errors_of((lowered, standing), task.seen)
    better_by, deviation = gain(errors, without)
    return standing if better_by > _REFUTED * deviation else lowered


def _settled(task: Task, found: Fit, noisy: bool) -> Fit:
    """The fit with the noise levels that the data show, knowing whether the ray corrections are noise.

    If they are, short edges are loosened in the end. If not, the image noise is lowered as long as that leaves the
    shared lengths where they are: what little noise is left would else crumple all views alike.
    """
    i, k = task.mesh.edges.T
    seen = task.seen[:, i] & task.seen[:, k]
    for _ in range(_ROUNDS):
        noise = found.noise.after_fit(found.residuals(), seen)
        if not noisy:
            noise = noise.lowered_image(found.shape.correction[task.seen])
        if noise.settled(found.noise):
            break
        again = refitted(task, found, noise)
        freed = noise.release > found.noise.release and not task.seen.all()  # which moves lengths for a good reason
        moved = float(np.median(np.abs(again.shape.log_length - found.shape.log_length)))
        if noise.image < found.noise.image and moved > noise.length and not freed:
            break
        found = again
    if noisy and found.misfit() >= BEYOND_DOUBT:
        found = refitted(task, found, replace(found.noise, turns=True))
    return replace(found, noisy=noisy)


def over_smooth_arcs(task: Task, found: Fit) -> tuple[Task, Fit]:
    """A settled isometric fit with arcs measured over smoothed surfaces (see `arcs`), and the task with it.

    Only noise of the image points asks for it. It stays unless points left out are predicted worse by more than a
    standard error, as on a surface whose wrinkles the smoothing would remove.
    """
    if not found.noisy or found.misfit() < BEYOND_DOUBT:
        return task, found
    smooth = task.smoothed(found.shape)
    again = refitted(smooth, found, found.noise)
    rough, errors = errors_of((found, again), task.seen)
    return (smooth, again) if within(_REFUTED, errors, rough) else (task, found)


def trusting_lengths(task: Task, found: Fit) -> Fit:
    """A settled fit with a quarter of the length noise, again and again, as far as points left out do not object.

    That tells what keeps its lengths, as paper does, from what stretches a little. Taken is the least length noise with
    which they are predicted within one standard error as well as with the best, the usual rule of cross-validation
    (Breiman et al., Classification and regression trees, 1984): where they do not tell, surfaces are isometric. Depths
    are not stated to be more accurate than with the largest length noise that they do not refute.

    Only noise of the image points asks for it, and slants are settled before: while lengths are held tightly they
    hardly move. What is pulled as a whole is never pulled quite evenly; tighter lengths would predict what is near, and
    tilt the rest.
    """
    if not found.noisy or found.misfit() < BEYOND_DOUBT or found.shape.strain.size:
        return found
    left_out, noise = HeldOut(found.shape, task.seen), found.noise

    def errors_under(noise: Noise) -> np.ndarray:
        return left_out.errors(task.measurements(noise, conformal=found.conformal))

    for level in (noise, noise.tighter(_STEP)):
        errors_under(level)  # fits have something left of the points left out until they have been elsewhere
    levels, errors, best = [noise], [errors_under(noise)], 0
    while best == len(errors) - 1 and levels[-1].length > _LEAST * task.config.length_sigma:
        levels.append(levels[-1].tighter(_STEP))
        errors.append(errors_under(levels[-1]))
        if gain(errors[-1], errors[best])[0] > 0.0:
            best = len(errors) - 1
    possible = [level for level, tried in zip(levels, errors, strict=True) if within(_REFUTED, tried, errors[best])]
    taken = possible[-1]
    if taken is not levels[-1]:
        between = taken.tighter(_STEP**0.5)
        if within(_REFUTED, errors_under(between), errors[best]):
            taken = between
    for level in (*(level for level in levels[1:] if level.length > taken.length), taken):
        found = refitted(task, found, level)
    return replace(to_the_end(found), length_doubt=possible[0].length / taken.length)


def without(task: Task, found: Fit, wrong: np.ndarray) -> Fit:
    """A finished isometric fit that goes on without a few observations.

    Args:
        task: without them.
        found: the fit with them.
        wrong: (F, P) bool, the observations.
    """
    before, shape, completed = found.measurements, found.shape, task.completed
    image = np.where(wrong[..., None], completed.image, before.image)
    weight = np.where(wrong, found.noise.image_weight(~wrong, completed.deviation), before.image_weight)
    rays = replace(shape, correction=before.image + shape.correction - image)
    found = to_the_end(replace(found, measurements=replace(before, image=image, image_weight=weight), shape=rays))
    found.evidence.update(noise_evidence(task, found))
    return found


def noise_evidence(task: Task, found: Fit) -> dict[str, Any]:
    """What a fit says about the noise."""
    noise, correction = found.noise, found.shape.correction
    return {
        "image noise": noise.image,
        "image noise over image length of an edge": float(np.sqrt(2.0)) * noise.image / noise.spacing,
        "length noise": noise.length,
        "short edges loosened": noise.turns,
        "loose edges": float((noise.looseness > _LOOSE).mean()),
        "patches assumed frontal": noise.patches,
        "root mean square ray correction": float(np.sqrt((correction[task.seen] ** 2).mean())),
        "correlation of neighbours' ray corrections": found.corrections_in_common(task.seen)[0],
        "median absolute length residual": float(np.median(np.abs(found.residuals()))),
        "bending": task.config.bending,
        "arcs over smoothed surfaces": found.measurements.arcs is not None,
    }
