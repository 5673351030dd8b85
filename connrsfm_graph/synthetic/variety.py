"""A variety of scenes: surfaces of many kinds, cameras at rest or moving, sizes, noise and gaps all drawn at random.

No two seeds are alike, so that a method is seen on what it was not made for. Rolls, waves, cones, planes, folds and
torn sheets are paper, which keeps its lengths; cloth, tissue and balloons stretch by a few per cent, faces by up to a
third about the mouth, rubber as a whole by up to a half.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from connrsfm_graph.errors import InputError
from connrsfm_graph.synthetic.corruption import with_missing, with_noise
from connrsfm_graph.synthetic.jet import Jet
from connrsfm_graph.synthetic.placing import facing_draws, flat_sheet, placed, rolled, smooth_motion
from connrsfm_graph.synthetic.scene import Scene
from connrsfm_graph.tracks.tracks import Tracks

_IMAGES, _POINTS = (6, 20), (40, 250)
"""Least and most."""
_NOISE = (0.3, 3.0)
"""Pixels of 640 x 480 images, drawn by their logarithm."""
_MISSING = 0.4
"""Largest part of the observations that is missing, where some are."""
_STIFF = ("plane", "rigid")
"""Kinds that tell nothing before a camera at rest."""
_POISSON = 0.4
"""By how much rubber gets narrower as it gets longer, in logarithms."""
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(12)

Surface = Callable[[Jet, Jet, np.ndarray], Jet]
"""Surface over the sheet's parameters in one image, from two numbers in [-1, 1] that move from image to image."""


def varied(kind: str, seed: int = 0) -> Tracks:
    """Tracks with truth of a scene of a kind, all else drawn at random.

    Args:
        kind: one of `KINDS`.
        seed: of everything.

    Raises:
        InputError: there is no such kind.
    """
    if kind not in KINDS:
        raise InputError(f"there is no kind of scene '{kind}', expected one of {', '.join(KINDS)}")
    rng = np.random.default_rng([list(KINDS).index(kind), seed])
    n_frames, n_points = (int(rng.integers(least, most + 1)) for least, most in (_IMAGES, _POINTS))
    at_rest, in_motion, gaps = rng.random(3) < 0.5
    at_rest &= kind not in _STIFF
    surface = KINDS[kind](rng)
    s, t = flat_sheet(n_points, rng)

    def draw() -> list[Jet]:
        motion = smooth_motion(n_frames, 8, rng) if in_motion else rng.uniform(-1.0, 1.0, (n_frames, 8))
        if at_rest:
            motion[:, 2:] = motion[0, 2:]
        return [placed(surface(s, t, m[:2]), m[2:], tilt_deg=25.0, fill=(0.6, 1.0)) for m in motion]

    tracks = with_noise(Scene.of(facing_draws(draw)).tracks, float(np.exp(rng.uniform(*np.log(_NOISE)))), seed)
    return with_missing(tracks, rng.uniform(0.0, _MISSING), seed) if gaps else tracks


def _plane(rng: np.random.Generator) -> Surface:
    """Does not bend at all."""
    return lambda s, t, motion: Jet.stack([s, t, 0.0 * s])


def _roll(rng: np.random.Generator) -> Surface:
    """Paper rolled to cylinders, of an axis that turns."""
    bend, axis, turn = rng.uniform(0.2, 1.0), rng.uniform(0.0, np.pi), rng.uniform(0.0, 1.0)
    return lambda s, t, motion: rolled((s, t), bend * motion[0], axis + turn * motion[1])


def _turned(s: Jet, t: Jet, angle: float) -> tuple[Jet, Jet]:
    """Coordinates along a direction of the sheet and across it."""
    return s * np.cos(angle) + t * np.sin(angle), t * np.cos(angle) - s * np.sin(angle)


def _ruled(along: Jet, across: Jet, axis: float, slope: Callable[[Jet], Jet]) -> Jet:
    """Paper with a slope angle that depends on the length along one direction of the sheet: isometric."""
    x = z = 0.0 * along
    for node, weight in zip(_NODES, _WEIGHTS, strict=True):
        angle, step = slope(along * (0.5 * (1.0 + node))), along * (0.5 * weight)
        x, z = x + (angle + np.pi / 2).sin() * step, z + angle.sin() * step
    return Jet.stack([*_turned(x, across, -axis), z])


def _waves(rng: np.random.Generator) -> Surface:
    """Paper with waves across one direction: its slope angle is a sine of the length along the sheet."""
    steep, axis, frequency = rng.uniform(0.2, 0.6), rng.uniform(0.0, np.pi), rng.uniform(1.5, 4.0)

    def surface(s: Jet, t: Jet, motion: np.ndarray) -> Jet:
        def slope(length: Jet) -> Jet:
            return (length * frequency + np.pi * motion[1]).sin() * (steep * motion[0])

        return _ruled(*_turned(s, t, axis), axis, slope)

    return surface


def _cone(rng: np.random.Generator) -> Surface:
    """Paper bent to cones about one apex beside the sheet, to either side."""
    distance, direction, most = rng.uniform(1.6, 3.0), rng.uniform(0.0, 2 * np.pi), rng.uniform(0.1, 0.5)

    def surface(s: Jet, t: Jet, motion: np.ndarray) -> Jet:
        along = s * np.cos(direction) + t * np.sin(direction) + distance
        across = t * np.cos(direction) - s * np.sin(direction)
        radius, angle = (along * along + across * across) ** 0.5, (across / along).arctan()
        narrow = 1.0 - most * abs(motion[0])
        turn, side = angle / narrow, 1.0 if motion[0] > 0 else -1.0
        x, y, z = (turn + np.pi / 2).sin() * narrow, turn.sin() * narrow, side * np.sqrt(1.0 - narrow**2)
        cone = Jet.stack([radius * x, radius * y, radius * z])
        tilt = side * np.arcsin(np.sqrt(1.0 - narrow**2))  # the generator through the sheet's middle lies flat
        level = np.array([[np.cos(tilt), 0.0, np.sin(tilt)], [0.0, 1.0, 0.0], [-np.sin(tilt), 0.0, np.cos(tilt)]])
        c, d = np.cos(direction), np.sin(direction)
        return cone.rotated(np.array([[c, -d, 0.0], [d, c, 0.0], [0.0, 0.0, 1.0]]) @ level)

    return surface


def _cloth(rng: np.random.Generator) -> Surface:
    """Two waves that run in different directions: stretches by a few per cent."""
    waves = [(rng.uniform(-3.0, 3.0, 2), rng.uniform(0.05, 0.15)) for _ in range(2)]

    def surface(s: Jet, t: Jet, motion: np.ndarray) -> Jet:
        moving = zip(waves, motion, strict=True)
        relief = (((s * k[0] + t * k[1] + np.pi * m).sin() * size) for (k, size), m in moving)
        return Jet.stack([s, t, sum(relief, start=0.0 * s)])

    return surface


def _tissue(rng: np.random.Generator) -> Surface:
    """A curved wall with two bumps that heave."""
    curved = rng.uniform(-0.2, 0.2, 2)
    bumps = [(rng.uniform(-0.6, 0.6, 2), rng.uniform(2.0, 6.0), rng.uniform(0.05, 0.2)) for _ in range(2)]

    def surface(s: Jet, t: Jet, motion: np.ndarray) -> Jet:
        relief = s * s * curved[0] + t * t * curved[1]
        for (centre, sharp, height), m in zip(bumps, motion, strict=True):
            away = (s - centre[0]) * (s - centre[0]) + (t - centre[1]) * (t - centre[1])
            relief = relief + (away * sharp + 1.0) ** -1.0 * (height * m)
        return Jet.stack([s, t, relief])

    return surface


def _balloon(rng: np.random.Generator) -> Surface:
    """A cap whose height breathes: stretches most in its middle."""
    height, breath = rng.uniform(0.2, 0.5) * rng.choice([-1.0, 1.0]), rng.uniform(0.1, 0.4)

    def surface(s: Jet, t: Jet, motion: np.ndarray) -> Jet:
        bulge = height * (1.0 + breath * motion[0])
        return Jet.stack([s, t, (2.0 - s * s - t * t) ** 0.5 * (-bulge) - s * (0.1 * motion[1])])

    return surface


def _rubber(rng: np.random.Generator) -> Surface:
    """A roll that is pulled along one direction, longer by up to a half and narrower with it."""
    bend, axis, pull, most = rng.uniform(0.2, 0.8), *rng.uniform(0.0, np.pi, 2), rng.uniform(0.1, 0.5)

    def surface(s: Jet, t: Jet, motion: np.ndarray) -> Jet:
        longer = 1.0 + 0.5 * most * (1.0 + motion[1])
        along, across = s * np.cos(pull) + t * np.sin(pull), t * np.cos(pull) - s * np.sin(pull)
        along, across = along * longer, across * longer**-_POISSON
        pulled = along * np.cos(pull) - across * np.sin(pull), along * np.sin(pull) + across * np.cos(pull)
        return rolled(pulled, bend * motion[0], axis)

    return surface


def _torn(rng: np.random.Generator) -> Surface:
    """A roll that is cut from its border to about the middle, the flaps on either side bent apart."""
    bend, axis, most = rng.uniform(0.1, 0.6), rng.uniform(0.0, 2 * np.pi), rng.uniform(0.3, 1.0)
    tip, beside = rng.uniform(-0.3, 0.2), rng.uniform(-0.2, 0.2)

    def surface(s: Jet, t: Jet, motion: np.ndarray) -> Jet:
        along, across = _turned(s, t, axis)
        side = np.sign(across.value - beside) * 0.5 * most * (1.0 + motion[1])

        def slope(length: Jet) -> Jet:
            flap = length * (length.value > 0.0)
            return length * (bend * motion[0]) + flap * flap * side

        return _ruled(along - tip, across, axis, slope)

    return surface


def _folded(rng: np.random.Generator) -> Surface:
    """Paper with one crease, which opens and closes; both sides stay plane."""
    axis, most, crease = rng.uniform(0.0, np.pi), rng.uniform(0.3, 0.8), rng.uniform(-0.3, 0.3)

    def surface(s: Jet, t: Jet, motion: np.ndarray) -> Jet:
        along, across = _turned(s, t, axis)
        along = along - crease
        angle = most * motion[0] * (along.value > 0.0)
        return Jet.stack([*_turned(along * np.cos(angle), across, -axis), along * np.sin(angle)])

    return surface


def _face(rng: np.random.Generator) -> Surface:
    """A curved relief whose lower part drops and whose sides bulge."""
    curved, nose = rng.uniform(0.2, 0.5), rng.uniform(0.1, 0.3)
    drop, bulge, mouth = rng.uniform(0.1, 0.25), rng.uniform(0.05, 0.15), rng.uniform(0.1, 0.3)

    def surface(s: Jet, t: Jet, motion: np.ndarray) -> Jet:
        lower = ((t - mouth) * 6.0).arctan() / np.pi + 0.5
        relief = (s * s + t * t * 0.6) * curved - ((s * s + t * t) * 12.0 + 1.0) ** -1.0 * nose
        for side in (-0.5, 0.5):
            away = (s - side) * (s - side) + (t - 0.15) * (t - 0.15)
            relief = relief - (away * 12.0 + 1.0) ** -1.0 * (bulge * motion[0])
        return Jet.stack([s, t + lower * (0.5 * drop * (1.0 + motion[1])), relief])

    return surface


def _rigid(rng: np.random.Generator) -> Surface:
    """A relief that only moves."""
    cloth = _cloth(rng)
    return lambda s, t, motion: cloth(s, t, np.array([0.3, -0.2]))


KINDS: dict[str, Callable[[np.random.Generator], Surface]] = {
    "roll": _roll,
    "waves": _waves,
    "cone": _cone,
    "plane": _plane,
    "cloth": _cloth,
    "tissue": _tissue,
    "balloon": _balloon,
    "rigid": _rigid,
    "rubber": _rubber,
    "torn": _torn,
    "folded": _folded,
    "face": _face,
}
"""Kinds of surfaces; one more entry adds one."""
