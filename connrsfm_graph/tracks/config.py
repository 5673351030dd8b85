"""Settings of the front end."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class TrackingConfig:
    """How many points are followed and how far a track is trusted."""

    points: int = 1000
    """Cells the object is divided into; the strongest corner of each is followed."""
    patch: int = 21
    """Side in pixels of the patch that is compared, odd."""
    levels: int = 3
    """Halvings of the image; the largest motion between images is about patch * 2^levels / 2 pixels."""
    max_return_error: float = 0.7
    """Largest distance in pixels between a point and itself followed forward and back."""
    neighbours: int = 10
    """Nearest points whose affinity a point must follow."""
    max_affine_error: float = 2.0
    """Largest distance in pixels from where that affinity puts the point, and from where registration puts it."""
    min_similarity: float = 0.7
    """Least correlation of the patch with how it looked at first."""
    min_share: float = 0.3
    """Tracks seen in a smaller share of the images are dropped."""
    rejoin: int = 5
    """Images between two searches for lost points; 0 for none."""
    every: int = 1
    """Use every n-th image."""
    first: int = 0
    """Number of the first image used, counted from 0."""
    last: int | None = None
    """Number of the last image used; all to the end where none."""

    def __post_init__(self) -> None:
        if self.patch < 5 or self.patch % 2 == 0:
            raise ValueError(f"patch is {self.patch}, expected an odd number from 5")
        if not 0 < self.min_share <= 1:
            raise ValueError(f"min_share is {self.min_share}, expected more than 0 and at most 1")
        for name, least in (("points", 1), ("levels", 0), ("neighbours", 3), ("rejoin", 0), ("every", 1)):
            if getattr(self, name) < least:
                raise ValueError(f"{name} is {getattr(self, name)}, expected {least} or more")
