"""The report's pictures of one image: its tracks, its surface from two sides, and the truth beside it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from connrsfm_graph.reconstruction import Reconstruction
from connrsfm_graph.report.colour import DEPTH, ERROR, point_colours, ramp_colours
from connrsfm_graph.report.photos import Photo
from connrsfm_graph.report.raster import Raster, View, turned
from connrsfm_graph.report.surfaces import Surfaces

SIZE = (342, 288)
"""Width and height of a picture in pixels."""
VIEWS = {"front": turned(0.0, 0.0), "side": turned(48.0, 22.0), "other": turned(-48.0, 22.0)}
OUTLIER = (0.82, 0.13, 0.16)


@dataclass(frozen=True)
class Picture:
    """A picture with its name and what it shows."""

    name: str
    caption: str
    rgba: np.ndarray
    """(height, width, 4) uint8."""

    def png(self) -> bytes:
        """The picture as the content of a PNG file."""
        return self._encoded(".png", [cv2.IMWRITE_PNG_COMPRESSION, 6])

    def webp(self) -> bytes:
        """The picture as the content of a WebP file, a quarter of the size and not exact."""
        return self._encoded(".webp", [cv2.IMWRITE_WEBP_QUALITY, 88])

    def _encoded(self, ending: str, settings: list[int]) -> bytes:
        done, data = cv2.imencode(ending, cv2.cvtColor(self.rgba, cv2.COLOR_RGBA2BGRA), settings)
        assert done
        return data.tobytes()


class Painter:
    """Draws the pictures of any image, all at the scale and with the colours of the whole sequence."""

    def __init__(self, reconstruction: Reconstruction, surfaces: Surfaces, photos: Sequence[Photo] | None = None):
        """Photos, where given, lie under the tracks."""
        self.reconstruction, self.surfaces, self.photos = reconstruction, surfaces, photos
        self.identity = point_colours(typical_place(reconstruction))
        reach = np.max([surfaces.reach(R) for R in VIEWS.values()], axis=0)
        scale = 0.47 * float((np.array(SIZE) / np.maximum(reach, np.finfo(float).tiny)).min())
        self.views = {name: View(R, scale, SIZE) for name, R in VIEWS.items()}

    def pictures(self, frame: int) -> Iterator[Picture]:
        """The pictures of one image, in the order in which a reader compares them."""
        yield Picture("tracks", "tracks", self.tracks(frame))
        surfaces = self.surfaces
        depth = ramp_colours(DEPTH, surfaces.relief[frame], *surfaces.relief_range())
        if surfaces.truth is None or surfaces.error is None:
            yield Picture("front", "from the camera", self.surface(surfaces.points, frame, "front", depth))
            yield Picture("side", "from the right", self.surface(surfaces.points, frame, "side", depth))
            yield Picture("other", "from the left", self.surface(surfaces.points, frame, "other", depth))
            return
        error = ramp_colours(ERROR, surfaces.error[frame], *surfaces.error_range())
        true_relief = surfaces.truth[frame, :, 2] - surfaces.centre[frame, 2]
        true_depth = ramp_colours(DEPTH, true_relief, *surfaces.relief_range())
        yield Picture("error", "from the camera, error", self.surface(surfaces.points, frame, "front", error))
        yield Picture("side", "from the right", self.surface(surfaces.points, frame, "side", depth))
        yield Picture("truth", "truth from the right", self.surface(surfaces.truth, frame, "side", true_depth))

    def surface(self, points: np.ndarray, frame: int, view: str, colours: np.ndarray) -> np.ndarray:
        """A surface (one of (F, P, 3)) with colours (P, 3), from a named view."""
        part = self.surfaces.triangles[frame]
        part = part[np.isfinite(points[frame][part]).all(axis=(1, 2))]
        return Raster.of(self.views[view], self.surfaces.centre[frame], points[frame], part).coloured(colours)

    def tracks(self, frame: int) -> np.ndarray:
        """The image's tracks, one colour per point in all images; wrong ones crossed out in red."""
        pixels = self.reconstruction.pixels[frame]
        scale, offset, canvas = self._canvas(frame)
        radius = 3 * 16 if len(pixels) <= 400 else 2 * 16
        for point in np.nonzero(self.reconstruction.visible[frame])[0]:
            # cv2 takes coordinates in sixteenths of a pixel here, for smooth dots.
            place = tuple(int(value) for value in np.round(16 * (scale * pixels[point] + offset)))
            if self.reconstruction.outlier[frame, point]:
                _cross(canvas, place, OUTLIER)
                continue
            colour = (*(255 * self.identity[point]), 255.0)
            cv2.circle(canvas, place, radius, colour, -1, cv2.LINE_AA, 4)
        return canvas

    def _canvas(self, frame: int) -> tuple[float, np.ndarray, np.ndarray]:
        """Scale and offset from pixels to the picture, and the picture before tracks are drawn."""
        width, height = SIZE
        if self.photos is not None:
            photo = self.photos[frame]
            photo_height, photo_width = photo.image.shape[:2]
            scale = min(width / photo_width, height / photo_height)
            grey = cv2.cvtColor(
                cv2.resize(photo.image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY
            )
            # Colours belong to the tracks, so the photo is grey and pale.
            pale = np.round(0.55 * grey + 0.45 * 255).astype(np.uint8)
            # Pixel centres are at whole coordinates in photo and picture.
            offset = scale * (photo.place(np.zeros(2)) + 0.5) - 0.5
            return scale * photo.scale, offset, cv2.cvtColor(pale, cv2.COLOR_GRAY2RGBA)
        pixels = self.reconstruction.pixels
        lower, upper = np.nanmin(pixels, axis=(0, 1)), np.nanmax(pixels, axis=(0, 1))
        margin = 14.0
        scale = float(((np.array(SIZE) - 2 * margin) / np.maximum(upper - lower, 1e-9)).min())
        # A fully transparent white, so that smooth borders of dots do not darken.
        canvas = np.zeros((height, width, 4), dtype=np.uint8)
        canvas[..., :3] = 255
        return scale, np.array(SIZE) / 2 - scale * (lower + upper) / 2, canvas


def _cross(canvas: np.ndarray, place: tuple[int, ...], colour: tuple[float, float, float]) -> None:
    rgba = (*(255 * value for value in colour), 255.0)
    for dx, dy in ((48, 48), (48, -48)):
        start, end = (place[0] - dx, place[1] - dy), (place[0] + dx, place[1] + dy)
        cv2.line(canvas, start, end, rgba, 2, cv2.LINE_AA, 4)


def typical_place(reconstruction: Reconstruction) -> np.ndarray:
    """(P, 2) where each point is in the image that sees most points, or elsewhere in the mean of its images."""
    pixels = np.where(reconstruction.visible[..., None], reconstruction.pixels, np.nan)
    best = pixels[reconstruction.visible.sum(axis=1).argmax()].copy()
    unseen = np.isnan(best).any(axis=1) & reconstruction.visible.any(axis=0)
    best[unseen] = np.nanmean(pixels[:, unseen], axis=0)
    return best
