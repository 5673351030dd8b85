"""Where the refinement starts: the mesh, one scale for all views, and the latent lengths."""

from __future__ import annotations

import numpy as np

from connrsfm_graph.refine.measurements import Shape
from connrsfm_graph.refine.mesh import Mesh, surface_mesh
from connrsfm_graph.refine.unseen import Completed
from factors.surface import PERSPECTIVE

_ROUNDS = 3
_NEIGHBOURS = 6


def log_chords(points: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """(F, E) log distances of point pairs (E, 2) in points (F, P, 3)."""
    chord = np.linalg.norm(points[:, edges[:, 0]] - points[:, edges[:, 1]], axis=-1)
    return np.log(np.maximum(chord, np.finfo(float).tiny))


def start_mesh(completed: Completed, visible: np.ndarray, rings: int) -> Mesh:
    """Mesh over the image of the view that shows the surface with the least foreshortening.

    In that view the image distances of neighbours are most nearly proportional to their distances in space.
    """
    points = PERSPECTIVE.points(completed.image, np.exp(completed.log_depth))

    def latent(edges: np.ndarray) -> np.ndarray:
        if len(edges) == 0:
            return np.empty(0)
        chords = log_chords(points, edges)
        return np.median(chords - np.median(chords, axis=1, keepdims=True), axis=0)

    position = completed.template.position
    square = ((position[:, None] - position[None]) ** 2).sum(axis=-1)
    neighbours = np.argsort(square, axis=1, kind="stable")[:, 1 : 1 + _NEIGHBOURS]
    pairs = np.stack([np.repeat(np.arange(len(square)), neighbours.shape[1]), neighbours.ravel()], axis=1)
    flat = np.concatenate([completed.image, np.ones_like(completed.image[..., :1])], axis=-1)
    ratio = log_chords(flat, pairs) - latent(pairs)
    foreshortening = np.median(np.abs(ratio - np.median(ratio, axis=1, keepdims=True)), axis=1)
    seen = visible.sum(axis=1)
    view = int(np.where(seen >= 0.9 * seen.max(), foreshortening, np.inf).argmin())
    return surface_mesh(completed.image[view], latent, rings)


def start_shape(completed: Completed, mesh: Mesh, conformal: bool = False) -> Shape:
    """Shape with the given depths: each view scaled by its median log length, lengths the medians over the views."""
    F, P = completed.log_depth.shape
    chords = log_chords(PERSPECTIVE.points(completed.image, np.exp(completed.log_depth)), mesh.edges)
    length = np.median(chords, axis=0)
    scale = np.zeros((F, 1))
    for _ in range(_ROUNDS):
        scale = np.median(chords - length, axis=1, keepdims=True)
        length = np.median(chords - scale, axis=0)
    unit = length.mean()
    return Shape(
        log_depth=completed.log_depth - scale - unit,
        correction=np.zeros((F, P, 2)),
        log_factor=np.zeros((F, P if conformal else 0)),
        log_length=length - unit,
        strain=np.zeros((F, 0)),
    )
