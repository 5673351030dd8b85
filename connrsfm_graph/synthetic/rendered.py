"""Images of a printed sheet that bends and moves before a perspective camera, with its true surface.

The sheet never stretches: in every frame it is a general cylinder, flat paper bent along one direction with a curvature
that varies over the sheet, whose direction and bends change with time. Each pixel's sight ray is intersected with that
surface by Newton's method, so texture, depth and the sheet's own coordinates at a pixel belong together exactly.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.interpolate import CubicSpline, LinearNDInterpolator
from scipy.spatial.transform import Rotation

from connrsfm_graph.synthetic.print_pattern import printed_pattern
from connrsfm_graph.tracks.tracks import Tracks

SHEET = (1.0, 0.75)
"""Width and height of the sheet, the unit of all lengths; its coordinates (a, b) are 0 in its middle."""
_STRIDE = 4
"""Sight rays are first intersected at every fourth pixel, the others start from there."""
_MARGIN = 1.12
"""The surface is continued to this multiple of the sheet, so that its border is solved for like its inside."""
_NEWTON_STEPS = 5
_SMALL_STEP = 1e-5
"""In units of the sheet's width."""
_LIGHT = np.array([0.35, -0.5, -0.8])
"""Direction towards the light in the camera frame."""


@dataclass(frozen=True)
class RenderConfig:
    """Size and motion of a rendered sequence."""

    frames: int = 16
    """Number of images."""
    width: int = 640
    """Image width in pixels."""
    height: int = 480
    """Image height in pixels."""
    focal: float = 620.0
    """Focal length in pixels."""
    bend: float = 1.0
    """Strength of the bending: at 1 the sheet's ends turn by up to about 80 degrees to each other, at 0 it is flat."""
    noise: float = 1.0
    """Standard deviation of the image noise in grey levels."""
    seed: int = 0
    """Seed of the print and the noise."""


@dataclass(frozen=True)
class BentSheet:
    """The sheet in one frame: a general cylinder in the camera frame (x right, y down, z forward)."""

    direction: np.ndarray
    """(2,) unit vector in sheet coordinates along which the sheet bends; it is straight across."""
    profile: CubicSpline
    """Cross-section by arc length: position along the unbent direction and height."""
    rotation: np.ndarray
    """(3, 3) from the sheet's frame (its middle, tangent there to the x-y plane) to the camera frame."""
    translation: np.ndarray
    """(3,) the sheet's middle in the camera frame."""

    def surface(self, ab: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points and their derivatives by a and b, each (..., 3), at sheet coordinates (..., 2)."""
        c, d = self.direction
        along, across = ab[..., 0] * c + ab[..., 1] * d, ab[..., 1] * c - ab[..., 0] * d
        x, z = np.moveaxis(self.profile(along), -1, 0)
        dx, dz = np.moveaxis(self.profile(along, 1), -1, 0)
        local = np.stack([x * c - across * d, x * d + across * c, z], axis=-1)
        by_along = np.stack([dx * c, dx * d, dz], axis=-1)
        by_across = np.array([-d, c, 0.0])
        by_a, by_b = c * by_along - d * by_across, d * by_along + c * by_across
        return local @ self.rotation.T + self.translation, by_a @ self.rotation.T, by_b @ self.rotation.T

    def seen_at(self, rays: np.ndarray, start: np.ndarray) -> np.ndarray:
        """Sheet coordinates (N, 2) at which sight rays (N, 2), normalised image coordinates, meet the surface.

        Newton's method from `start` (N, 2); a ray is done when a step is so small that the next one, its square, is
        beyond what matters.
        """
        ab = start.copy()
        moving = np.arange(len(ab))
        for _ in range(_NEWTON_STEPS):
            point, by_a, by_b = self.surface(ab[moving])
            z = point[:, 2]
            u, v = point[:, 0] / z, point[:, 1] / z
            ru, rv = (rays[moving, 0] - u) * z, (rays[moving, 1] - v) * z
            ua, ub = by_a[:, 0] - u * by_a[:, 2], by_b[:, 0] - u * by_b[:, 2]
            va, vb = by_a[:, 1] - v * by_a[:, 2], by_b[:, 1] - v * by_b[:, 2]
            step = np.column_stack([vb * ru - ub * rv, ua * rv - va * ru]) / (ua * vb - ub * va)[:, None]
            ab[moving] += step
            moving = moving[np.abs(step).max(axis=1) > _SMALL_STEP]
            if not len(moving):
                break
        return ab


@dataclass(frozen=True)
class RenderedSequence:
    """F images of H x W pixels and the surface they show."""

    images: np.ndarray
    """(F, H, W, 3) uint8, red, green, blue."""
    K: np.ndarray
    """(3, 3) pinhole intrinsics in pixels."""
    depth: np.ndarray
    """(F, H, W) depth along z at the centre of every pixel, NaN beside the sheet."""
    sheet: np.ndarray
    """(F, H, W, 2) sheet coordinates (a, b) at the centre of every pixel, NaN beside the sheet."""
    surfaces: tuple[BentSheet, ...]
    """The sheet in every frame."""

    def sheet_at(self, tracks: Tracks) -> np.ndarray:
        """(F, P, 2) sheet coordinates at tracked pixels, NaN where not visible or beside the sheet.

        A perfect track keeps its sheet coordinates in all frames.
        """
        rays = tracks.normalised()
        ab = np.full(rays.shape, np.nan)
        for f, surface in enumerate(self.surfaces):
            seen = np.flatnonzero(tracks.visible[f])
            x, y = np.rint(tracks.pixels[f, seen]).astype(int).T
            inside = (x >= 0) & (y >= 0) & (x < self.sheet.shape[2]) & (y < self.sheet.shape[1])
            seen, nearest = seen[inside], self.sheet[f, y[inside], x[inside]]
            on_sheet = np.isfinite(nearest).all(axis=-1)
            ab[f, seen[on_sheet]] = surface.seen_at(rays[f, seen[on_sheet]], nearest[on_sheet])
        return ab

    def truth_for(self, tracks: Tracks) -> Tracks:
        """The tracks with the true points and normals of what lies at their pixels, NaN beside the sheet."""
        ab = self.sheet_at(tracks)
        parts = [surface.surface(x) for surface, x in zip(self.surfaces, ab, strict=True)]
        points, by_a, by_b = (np.stack(part) for part in zip(*parts, strict=True))
        return replace(tracks, points=points, normals=_normals(by_a, by_b))


def render_sequence(
    config: RenderConfig | None = None, progress: Callable[[int, int], None] | None = None
) -> RenderedSequence:
    """Render a bending, moving printed sheet.

    Args:
        config: sizes and motion.
        progress: called with the number of images done and in all.
    """
    config = config or RenderConfig()
    rng = np.random.default_rng(config.seed)
    pattern = printed_pattern(SHEET, round(1.5 * config.width), rng)
    K = np.array([[config.focal, 0, (config.width - 1) / 2], [0, config.focal, (config.height - 1) / 2], [0, 0, 1]])
    surfaces = tuple(_posed(f / max(config.frames - 1, 1), config) for f in range(config.frames))
    images, depths, sheets = [], [], []
    for surface in surfaces:
        ab = _intersect(surface, K, config)
        image, depth, inside = _rendered(surface, ab, pattern)
        image += rng.normal(0.0, config.noise, image.shape[:2])[..., None]
        images.append(np.clip(np.rint(image), 0, 255).astype(np.uint8))
        sheets.append(np.where(inside[..., None], ab, np.nan))
        depths.append(np.where(inside, depth, np.nan))
        if progress is not None:
            progress(len(images), config.frames)
    return RenderedSequence(np.stack(images), K, np.stack(depths), np.stack(sheets), surfaces)


def _posed(time: float, config: RenderConfig) -> BentSheet:
    """The sheet at a time in [0, 1]: smooth motions of unrelated periods."""

    def swing(periods: float, phase: float) -> float:
        return float(np.sin(2 * np.pi * (periods * time + phase)))

    angle = 0.5 * swing(0.6, 0.05)
    arc = np.linspace(-1.0, 1.0, 801)
    curvature = config.bend * (
        0.9 * swing(0.8, 0.0) - 0.3 + 0.9 * np.sin(2 * np.pi * (arc - 0.5 * time)) * swing(0.5, 0.2)
    )
    turn = CubicSpline(arc, curvature).antiderivative()
    heading = turn(arc) - turn(0.0)
    profile = CubicSpline(arc, np.column_stack([np.cos(heading), np.sin(heading)])).antiderivative()
    middle = profile(0.0)
    profile = CubicSpline(arc, profile(arc) - middle)
    rotation = Rotation.from_euler(
        "yxz", [0.3 * swing(0.9, 0.55), 0.2 * swing(0.7, 0.3), 0.15 * swing(0.5, 0.1)]
    ).as_matrix()
    translation = np.array([0.06 * swing(0.7, 0.0), 0.025 + 0.02 * swing(1.1, 0.25), 1.37 + 0.1 * swing(0.6, 0.6)])
    return BentSheet(np.array([np.cos(angle), np.sin(angle)]), profile, rotation, translation)


def _intersect(surface: BentSheet, K: np.ndarray, config: RenderConfig) -> np.ndarray:
    """(H, W, 2) sheet coordinates seen at every pixel, a little beyond the sheet's border, NaN farther out."""
    a, b = (_MARGIN * side * np.linspace(-0.5, 0.5, 41) for side in SHEET)
    grid = np.stack(np.meshgrid(a, b), axis=-1).reshape(-1, 2)
    point = surface.surface(grid)[0]
    columns, rows = (np.arange(0, size + 2 * _STRIDE, _STRIDE) for size in (config.width, config.height))
    coarse = _rays(columns, rows, K)
    ab = LinearNDInterpolator(point[:, :2] / point[:, 2:], grid)(coarse)
    known = np.isfinite(ab[..., 0])
    ab[known] = surface.seen_at(coarse[known], ab[known])

    x, y = np.meshgrid(np.arange(config.width), np.arange(config.height))
    fine = np.asarray(_sampled(ab.astype(np.float32), x / _STRIDE, y / _STRIDE, cv2.INTER_LINEAR), dtype=np.float64)
    known = np.isfinite(fine[..., 0])
    rays = _rays(np.arange(config.width), np.arange(config.height), K)
    fine[known] = surface.seen_at(rays[known], fine[known])
    return fine


def _rendered(surface: BentSheet, ab: np.ndarray, pattern: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The image (H, W, 3) float without noise, the depth (H, W), and where a pixel's centre shows the sheet."""
    size = np.array(SHEET)
    known = np.isfinite(ab[..., 0])
    point, by_a, by_b = surface.surface(ab[known])
    depth = np.full(known.shape, np.nan)
    depth[known] = point[:, 2]
    texel = (ab / size + 0.5) * pattern.shape[1::-1] - 0.5
    colour = _sampled(pattern, texel[..., 0], texel[..., 1], cv2.INTER_CUBIC).astype(np.float64)
    light = _normals(by_a, by_b) @ (_LIGHT / np.linalg.norm(_LIGHT))
    colour[known] *= 0.55 + 0.5 * np.clip(light, 0.0, 1.0)[:, None]

    # Distance to the sheet's border in pixels gives the share of a border pixel that the sheet covers.
    border = np.minimum(*np.moveaxis(size / 2 - np.abs(ab), -1, 0))
    slope = np.hypot(*np.gradient(border))
    cover = np.nan_to_num(np.clip(border / slope + 0.5, 0.0, 1.0))
    rows = np.linspace(0.0, 1.0, len(ab))[:, None, None]
    wall = np.array([96.0, 104.0, 112.0]) * (1.1 - 0.35 * rows)
    shadow = np.roll(cv2.GaussianBlur(cover.astype(np.float32), (0, 0), 14), (14, 10), (0, 1))[..., None]
    cover = cover[..., None]
    return cover * colour + (1 - cover) * wall * (1 - 0.45 * shadow), depth, border >= 0


def _normals(by_a: np.ndarray, by_b: np.ndarray) -> np.ndarray:
    """Unit normals (..., 3) towards the camera from the derivatives of a surface seen from its front."""
    normal = np.cross(by_b, by_a)
    return normal / np.linalg.norm(normal, axis=-1, keepdims=True)


def _rays(columns: np.ndarray, rows: np.ndarray, K: np.ndarray) -> np.ndarray:
    """(rows, columns, 2) normalised image coordinates of pixels."""
    x, y = np.meshgrid((columns - K[0, 2]) / K[0, 0], (rows - K[1, 2]) / K[1, 1])
    return np.stack([x, y], axis=-1)


def _sampled(image: np.ndarray, x: np.ndarray, y: np.ndarray, method: int) -> np.ndarray:
    """(H, W, C) values of an image between its pixels; NaN beyond its border where it is of floats, 0 where not."""
    outside = np.nan if image.dtype == np.float32 else 0.0
    x, y = (np.nan_to_num(c, nan=-1e4).astype(np.float32) for c in (x, y))
    sampled = cv2.remap(image, x, y, method, borderMode=cv2.BORDER_CONSTANT, borderValue=(outside,) * 4)
    return np.asarray(sampled)
