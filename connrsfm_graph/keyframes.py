"""Long sequences: the images that are reconstructed jointly, and the one that each other image starts from.

The surface's lengths, the noise and the model follow from some tens of images as surely as from thousands. Those
images, the keyframes, are spread evenly over the sequence; every other image is joined to the keyframe that looks most
like it by one edge of the image graph and follows it, with all that belongs to the keyframes held.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from connrsfm_graph.errors import InputError

_SIGHTINGS = 2
"""Keyframes in which a point should be seen, if it is seen in so many images at all."""


@dataclass(frozen=True)
class KeyframeConfig:
    """How long sequences are reconstructed."""

    most: int | None = 32
    """Images reconstructed jointly; in a longer sequence so many keyframes are, more where tracks come and go, and the
    others follow them one by one. none: all images jointly. Needs the refinement."""

    def __post_init__(self) -> None:
        if self.most is not None and self.most < 5:
            raise InputError(f"keyframes.most is {self.most}, expected at least 5, or none")


def choose_keyframes(visible: np.ndarray, config: KeyframeConfig, min_shared: int) -> np.ndarray:
    """(K,) sorted numbers of the images to reconstruct jointly; all of a short sequence.

    Evenly spaced, with more where points would else be missed. Where the keyframes do not hang together, or an image
    shares too little with all of them, there must be more of them.

    Args:
        visible: (F, P) bool.
        config: settings.
        min_shared: tracks that two images must share to be related.
    """
    F = len(visible)
    number = F if config.most is None else config.most
    while number < F:
        keys = _covering(visible, np.unique(np.linspace(0, F - 1, number).round().astype(int)))
        if len(keys) < F and _sufficient(visible, keys, min_shared):
            return keys
        number *= 2
    return np.arange(F)


def nearest_keyframe(
    image: np.ndarray, visible: np.ndarray, key_image: np.ndarray, key_visible: np.ndarray, min_shared: int
) -> np.ndarray:
    """(B,) the keyframe whose layout of shared points is nearest to that of each image, up to a similarity.

    With centred points as complex numbers z the distance is 1 - |<z_a, z_b>|^2 / (|z_a|^2 |z_b|^2).

    Args:
        image: (B, P, 2) image points, any value where not visible.
        visible: (B, P) bool.
        key_image, key_visible: the same for K keyframes.
        min_shared: tracks that an image must share with its keyframe.
    """
    seen, key_seen = visible.astype(float), key_visible.astype(float).T
    z = np.where(visible, image[..., 0] + 1j * image[..., 1], 0.0)
    key_z = np.where(key_visible, key_image[..., 0] + 1j * key_image[..., 1], 0.0).T
    shared = seen @ key_seen
    count = np.maximum(shared, 1.0)
    total, key_total = z @ key_seen, seen @ key_z
    product = np.abs(z.conj() @ key_z - total.conj() * key_total / count) ** 2
    size = (np.abs(z) ** 2 @ key_seen - np.abs(total) ** 2 / count) * (
        seen @ np.abs(key_z) ** 2 - np.abs(key_total) ** 2 / count
    )
    distance = 1.0 - np.divide(product, size, out=np.zeros_like(size), where=size > 0)
    return np.where(shared >= min(min_shared, shared.max()), distance, np.inf).argmin(axis=1)


def _covering(visible: np.ndarray, keys: np.ndarray) -> np.ndarray:
    """Keyframes with those added that see most of the points seen too rarely, until there are none."""
    wanted = np.minimum(visible.sum(axis=0), _SIGHTINGS)
    while (missing := visible[keys].sum(axis=0) < wanted).any():
        gain = (visible & missing).sum(axis=1)
        gain[keys] = 0
        keys = np.union1d(keys, [int(gain.argmax())])
    return keys


def _sufficient(visible: np.ndarray, keys: np.ndarray, min_shared: int) -> bool:
    """Whether keyframes are linked by shared tracks, and every image with one of them."""
    key_seen = visible[keys].astype(np.float32)
    linked = key_seen @ key_seen.T >= min_shared
    reached = linked[0]
    while (more := linked[reached].any(axis=0)).sum() > reached.sum():
        reached = more
    return bool(reached.all()) and bool((visible.astype(np.float32) @ key_seen.T).max(axis=1).min() >= min_shared)
