"""A synthetic scene: tracks with everything the method estimates known exactly.

All frames' surfaces are functions of the same two parameters, so a warp between two images is one image map composed
with the inverse of the other, and its 2-jet follows from theirs without approximation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.synthetic.jet import Jet
from connrsfm_graph.tracks.tracks import Tracks
from factors.surface import PERSPECTIVE, Camera, normals
from factors.warp_jet import WarpJet

WIDTH, HEIGHT, FOCAL_LENGTH = 640, 480, 500.0
"""The virtual camera, in pixels."""
INTRINSICS = np.array(
    [[FOCAL_LENGTH, 0.0, (WIDTH - 1) / 2], [0.0, FOCAL_LENGTH, (HEIGHT - 1) / 2], [0.0, 0.0, 1.0]],
)


@dataclass(frozen=True)
class Scene:
    """F views of a deforming surface at P points, with exact truth. Camera frames: x right, y down, z forward."""

    tracks: Tracks
    """Pixels of the virtual camera, true points and true normals; everything visible."""
    first_order: np.ndarray
    """(F, P, 2) true y1, y2."""
    second_order: np.ndarray
    """(F, P, 3) true y11, y12, y22."""
    log_depth: np.ndarray
    """(F, P) log of the true depth; the depth itself where the camera is orthographic."""
    log_size: np.ndarray
    """(F, P) log of the local size of the surface over the parameter plane: a quarter of log det of its metric."""
    surfaces: tuple[Jet, ...]
    """Surface of every frame in its camera frame, as vectors of 3 jets at P points."""

    @staticmethod
    def of(surfaces: Sequence[Jet], camera: Camera = PERSPECTIVE) -> Scene:
        """The scene of surfaces given over common parameters that run right and down as seen by the cameras.

        The pixels of an orthographic camera are as many per unit of length as the focal length of the perspective one.

        Raises:
            InputError: a surface does not face its camera everywhere.
        """
        for f, surface in enumerate(surfaces):
            if facing(surface, camera).min() <= 0:
                raise InputError(f"surface {f} of the synthetic scene does not face the camera everywhere")
        points = np.stack([surface.value.T for surface in surfaces])
        image = np.stack([_project(surface, camera).value.T for surface in surfaces])
        first, second = zip(*(_depth_derivatives(surface, camera) for surface in surfaces), strict=True)
        return Scene(
            tracks=Tracks.checked(
                pixels=FOCAL_LENGTH * image + INTRINSICS[:2, 2],
                K=INTRINSICS,
                points=points,
                normals=normals(image, np.stack(first), camera),
                camera=camera.name,
                source="synthetic scene",
            ),
            first_order=np.stack(first),
            second_order=np.stack(second),
            log_depth=np.log(points[..., 2]) if camera.kappa else points[..., 2],
            log_size=np.stack([_log_size(surface) for surface in surfaces]),
            surfaces=tuple(surfaces),
        )

    @property
    def image(self) -> np.ndarray:
        """(F, P, 2) normalised image coordinates without the rounding of pixels."""
        return np.stack([_project(surface, self.tracks.camera).value.T for surface in self.surfaces])

    def jets(self, edges: np.ndarray) -> WarpJet:
        """Exact 2-jets of the warps of edges (E, 2), with leading dimensions (E, P)."""
        images = [_project(surface, self.tracks.camera) for surface in self.surfaces]
        warps = np.stack([images[b].over(images[a]).data for a, b in edges])  # (E, 6, 2, P)
        per_point = np.moveaxis(warps, (3, 2, 1), (1, 2, 3))
        return WarpJet(per_point[..., 0], per_point[..., 1:3].copy(), per_point[..., 3:].copy())

    def conformal_scale(self, edges: np.ndarray) -> np.ndarray:
        """True lambda (E, P) of edges (E, 2): local size in image a over local size in image b."""
        a, b = np.asarray(edges).T
        return np.exp(self.log_size[a] - self.log_size[b])


def facing(surface: Jet, camera: Camera = PERSPECTIVE) -> np.ndarray:
    """(P,) cosine between sight ray and inward normal: 1 seen head-on, 0 at the horizon, negative from behind."""
    normal = inward_normal(surface)
    ray = surface.value if camera.kappa else np.array([[0.0], [0.0], [1.0]])
    return (ray * normal).sum(axis=0) / (np.linalg.norm(ray, axis=0) * np.linalg.norm(normal, axis=0))


def inward_normal(surface: Jet) -> np.ndarray:
    """(3, P) product of the tangents: away from the camera, as long as the area of the surface over the parameters'."""
    along_s, along_t = surface.gradient
    return np.cross(along_s, along_t, axis=0)


def _project(surface: Jet, camera: Camera) -> Jet:
    if not camera.kappa:
        return Jet.stack([surface[0], surface[1]])
    return Jet.stack([surface[0] / surface[2], surface[1] / surface[2]])


def _depth_derivatives(surface: Jet, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """First-order (P, 2) and second-order (P, 3) terms: beta's own where the camera is orthographic, else from those of
    l = log beta: y_ij = l_ij + l_i l_j."""
    image = _project(surface, camera)
    if not camera.kappa:
        depth = surface[2].over(image)
        return depth.gradient.T, depth.hessian.T
    log_depth = surface[2].log().over(image)
    y1, y2 = log_depth.gradient
    return log_depth.gradient.T, (log_depth.hessian + np.stack([y1 * y1, y1 * y2, y2 * y2])).T


def _log_size(surface: Jet) -> np.ndarray:
    return 0.5 * np.log(np.linalg.norm(inward_normal(surface), axis=0))
