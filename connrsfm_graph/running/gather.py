"""The result while its images come in: keyframes first, then the others in any order; in memory, or mapped to disk."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import numpy as np

from connrsfm_graph.files import release
from connrsfm_graph.image_graph import ImageGraph
from connrsfm_graph.others import Others
from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.surfaces import Surfaces
from connrsfm_graph.tracks import Tracks


class Gathering:
    """Arrays of a result that are filled image by image."""

    def __init__(
        self,
        tracks: Tracks,
        keys: np.ndarray,
        graph: ImageGraph,
        surfaces: Surfaces,
        conformal_scale: np.ndarray,
        folder: Path | None = None,
    ) -> None:
        """Start with the keyframes.

        Args:
            tracks: of all F images.
            keys: (K,) numbers of the keyframes.
            graph: their image graph.
            surfaces: theirs.
            conformal_scale: (E, P) on the edges of their graph.
            folder: where the arrays lie, in memory where None.
        """
        self.following = np.setdiff1d(np.arange(tracks.n_frames), keys)
        """(F - K,) numbers of the images that follow keyframes."""
        self._tracks, self._keys = tracks, keys
        self._folder = folder
        self._problems: list[tuple[int, int, str]] = []
        self._known = len(graph.edges)
        """Edges before those of the images that follow, one each."""
        F, E = tracks.n_frames, self._known + len(self.following)
        values = {item.name: getattr(surfaces, item.name) for item in fields(surfaces)}
        values = {name: value for name, value in values.items() if value is not None}
        self._surfaces = {name: self._empty(name, F, value) for name, value in values.items()}
        self._edges = {
            name: self._empty(name, E, value)
            for name, value in (
                ("edges", graph.edges),
                ("edge_weight", graph.weight),
                ("conformal_scale", conformal_scale),
            )
        }
        for name, value in values.items():
            self._surfaces[name][keys] = value
        edges = (keys[graph.edges], graph.weight, conformal_scale)
        for array, value in zip(self._edges.values(), edges, strict=True):
            array[: self._known] = value

    def add(self, first: int, others: Others) -> None:
        """Images that follow keyframes, from the one at place `first` among all that do."""
        places = slice(first, first + len(others.keyframe))
        frames = self.following[places]
        for name, array in self._surfaces.items():
            array[frames] = getattr(others.surfaces, name)
        leader = self._keys[others.keyframe]
        edges = np.sort(np.stack([leader, frames], axis=1), axis=1)
        backwards = (frames < leader)[:, None]  # edges run from the lower image to the higher
        scale = np.where(backwards, 1.0 / others.conformal_scale, others.conformal_scale)
        rows = slice(self._known + places.start, self._known + places.stop)
        for array, value in zip(self._edges.values(), (edges, others.edge_weight, scale), strict=True):
            array[rows] = value
        ends = zip(leader.tolist(), frames.tolist(), others.problem, strict=True)
        self._problems += [(a, b, problem) for a, b, problem in ends if problem]
        for array in (*self._surfaces.values(), *self._edges.values()):
            release(array)

    def problems(self) -> list[tuple[int, int, str]]:
        """Keyframe and image of every warp with a problem, and what it is, in the order of the images."""
        return sorted(self._problems, key=lambda problem: problem[1])

    def result(self) -> Reconstruction:
        """The reconstruction of all images."""
        arrays = dict(self._surfaces)
        alternative, ambiguous = arrays.pop("alternative", None), arrays.pop("ambiguous")
        names = self._tracks.image_names
        return Reconstruction(
            pixels=self._tracks.pixels,
            K=self._tracks.K,
            visible=self._tracks.visible,
            **arrays,
            **self._edges,
            image_names=None if names is None else np.asarray(names),
            ambiguous=None if alternative is None else ambiguous,
            alternative=alternative,
            camera=self._tracks.camera,
        )

    def _empty(self, name: str, length: int, like: np.ndarray) -> np.ndarray:
        shape = (length, *like.shape[1:])
        if self._folder is None:
            return np.empty(shape, like.dtype)
        self._folder.mkdir(parents=True, exist_ok=True)
        return np.lib.format.open_memmap(self._folder / f"{name}.npy", mode="w+", dtype=like.dtype, shape=shape)
