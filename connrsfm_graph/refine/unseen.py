"""Points where they were not seen: first guesses from the points around them.

The tracks of all views are gathered on one plane, the template. A view is then a smooth map of the template, fitted
to the points it sees; it tells where the others are, and how surely.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.refine.thin_plate import fit_thin_plate

_APART = 1e-5
"""How far points at one place are moved from there, over the extent of the image points."""


@dataclass(frozen=True)
class Template:
    """All points on one plane."""

    position: np.ndarray
    """(P, 2) about the image of the view that sees most."""
    deviation: np.ndarray
    """(P,) standard deviation of a coordinate; 0 for the points of that view."""


@dataclass(frozen=True)
class Completed:
    """Views with values at all points."""

    template: Template
    """All points on one plane."""
    image: np.ndarray
    """(F, P, 2) image points, interpolated where not seen, no two at one place."""
    log_depth: np.ndarray
    """(F, P) likewise."""
    deviation: np.ndarray
    """(F, P) standard deviation of a coordinate of the interpolated image points, 0 where seen."""


def complete(
    image: np.ndarray, visible: np.ndarray, log_depth: np.ndarray, template: Template | None = None
) -> Completed:
    """Interpolate what was not seen.

    Args:
        image: (F, P, 2) normalised coordinates, any value where not visible.
        visible: (F, P) bool; every point in some view, every view with some point.
        log_depth: (F, P); where a visible one is NaN it is interpolated as well.
        template: of all points; made from these views where None.

    Raises:
        InputError: a view has fewer than two points with a depth, or none in common with the others.
    """
    template = template or make_template(image, visible)
    known = visible & np.isfinite(log_depth)
    log_depth = log_depth.copy()
    for f in range(len(visible)):
        if known[f].sum() < 2:
            raise InputError(f"refinement: image {f} has fewer than two points with a depth to start from")
        if not known[f].all():
            surface = fit_thin_plate(template.position[known[f]], log_depth[f, known[f], None])
            log_depth[f, ~known[f]] = surface(template.position[~known[f]])[:, 0]
    image, deviation = complete_images(image, visible, template)
    return Completed(template, image, log_depth, deviation)


def complete_images(image: np.ndarray, visible: np.ndarray, template: Template) -> tuple[np.ndarray, np.ndarray]:
    """Image points (F, P, 2) with those not seen interpolated, and the (F, P) deviations of these.

    No two points of a view are left at one place: of a chord without length nothing says where to it should grow.
    """
    image, deviation, position = image.copy(), np.zeros(visible.shape), template.position
    for f, seen in enumerate(visible):
        if not seen.all():
            warp = fit_thin_plate(position[seen], image[f, seen])
            image[f, ~seen] = warp(position[~seen])
            deviation[f, ~seen] = np.hypot(warp.deviation(position[~seen]), template.deviation[~seen])
        image[f] = _apart(image[f])
    return image, deviation


def _apart(image: np.ndarray) -> np.ndarray:
    """Points (P, 2), those at one place each moved a little in a direction of its own."""
    _, place, count = np.unique(image, axis=0, return_inverse=True, return_counts=True)
    together = np.flatnonzero(count[place.reshape(-1)] > 1)
    direction = np.stack([np.cos(together), np.sin(together)], axis=1)
    moved = image.copy()
    moved[together] += _APART * np.ptp(image, axis=0).max() * direction
    return moved


def make_template(image: np.ndarray, visible: np.ndarray) -> Template:
    """All points on the image plane of the view that sees most, other views warped onto it one by one."""
    base = int(visible.sum(axis=1).argmax())
    template, known = np.where(visible[base, :, None], image[base], 0.0), visible[base].copy()
    deviation = np.zeros(len(template))
    unseen = np.flatnonzero(~visible.any(axis=0))
    if len(unseen):
        raise InputError(f"refinement: point {unseen[0]} is seen in no image, expected points seen at least once")
    while not known.all():
        shared = (visible & known).sum(axis=1)
        view = int(np.where((visible & ~known).any(axis=1), shared, -1).argmax())
        if shared[view] == 0:
            raise InputError(f"refinement: image {view} shares no track with the others")
        common, new = visible[view] & known, visible[view] & ~known
        warp = fit_thin_plate(image[view, common], template[common])
        template[new], deviation[new] = warp(image[view, new]), warp.deviation(image[view, new])
        known |= new
    return Template(template, deviation)
