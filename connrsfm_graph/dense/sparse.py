"""What a dense surface is made from: the sparse points of one image."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from connrsfm_graph.reconstruction import Reconstruction


@dataclass(frozen=True)
class SparsePoints:
    """Points of one image's surface, all known."""

    pixels: np.ndarray
    """(N, 2) where the image shows them."""
    depth: np.ndarray
    """(N,) depth along z."""
    normals: np.ndarray
    """(N, 3) unit normals towards the camera, in the camera frame."""
    K: np.ndarray
    """(3, 3) intrinsics."""

    @staticmethod
    def of(reconstruction: Reconstruction, frame: int) -> SparsePoints:
        """Points that the image shows, that were recovered and whose tracks were not judged wrong.

        Points are taken where their surface projects, which the refinement moved from the track by its noise.
        """
        used = (reconstruction.visible & reconstruction.recovered & ~reconstruction.outlier)[frame]
        used &= np.isfinite(reconstruction.normals[frame]).all(axis=-1)
        points, K = reconstruction.points[frame, used], reconstruction.K[frame]
        projected = points @ K.T
        return SparsePoints(projected[:, :2] / projected[:, 2:], points[:, 2], reconstruction.normals[frame, used], K)

    def __len__(self) -> int:
        return len(self.depth)
