"""A fit under the noise levels that the data show."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from connrsfm_graph.refine.held_out import prediction_errors, predicts_better
from connrsfm_graph.refine.noise import neighbour_correlation
from connrsfm_graph.refine.task import Fit, Task, refitted

BEYOND_DOUBT = 0.05
"""A fit that leaves less than this is right, whatever its ray corrections look like."""
_ROUNDS = 3
"""Fits with noise levels that the one before has shown, at most."""
_HALVINGS = 2
"""How often the assumed length noise may be halved."""


def settled(task: Task, found: Fit) -> Fit:
    """The fit with the noise levels that the data show.

    Where the ray corrections look like noise, the image noise stands and the lengths are trusted more, if that predicts
    image points better. Where they do not, the image noise was assumed too large, as long as that leaves the
    shared lengths where they are: what little noise is left would else crumple all views alike.
    """
    noisy = found.looks_like_noise(task)
    if noisy:
        found = _trusting_lengths(task, found)
    for _ in range(_ROUNDS):
        noise = found.noise.after_fit(found.residuals())
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
    found.evidence.update(noise_evidence(task, found))
    return replace(found, noisy=noisy)


def _trusting_lengths(task: Task, found: Fit) -> Fit:
    """The fit with half the length noise, or a quarter, where points left out are predicted better."""
    if found.misfit() < BEYOND_DOUBT:
        return found
    errors = prediction_errors(found.measurements, found.shape, task.seen)
    trial = found
    for _ in range(_HALVINGS):
        trial = refitted(task, trial, trial.noise.halved_length())
        new = prediction_errors(trial.measurements, trial.shape, task.seen)
        if predicts_better(new, errors):
            found, errors = trial, new
    return found


def noise_evidence(task: Task, found: Fit) -> dict[str, Any]:
    """What a fit says about the noise."""
    noise, correction = found.noise, found.shape.correction
    return {
        "image noise": noise.image,
        "image noise over image length of an edge": float(np.sqrt(2.0)) * noise.image / noise.spacing,
        "length noise": noise.length,
        "patches assumed frontal": noise.patches,
        "root mean square ray correction": float(np.sqrt((correction[task.seen] ** 2).mean())),
        "correlation of neighbours' ray corrections": neighbour_correlation(correction, task.seen, task.mesh)[0],
        "median absolute length residual": float(np.median(np.abs(found.residuals()))),
        "bending": task.config.bending,
    }
