"""GTSAM keys that decode to words.

A key packs a letter (8 bits), a first index (32 bits) and a second index (24 bits): "point 12, view 3". The letters
`x`, `l` and `p` of common SLAM code are left to the user.

| letter | variable | indices | length |
|---|---|---|---|
| `d` | first-order terms y1, y2 | point, view | 2 |
| `c` | second-order terms y11, y12, y22 | point, view | 3 |
| `b` | log depth | point, view | 1 |
| `s` | log conformal scale | point, edge | 1 |
| `q` | correction of the sight ray | point, view | 2 |
| `f` | log conformal factor of a view | point, view | 1 |
| `e` | latent log edge length | mesh edge, 0 | 1 |
| `h` | homogeneous strain of a view | 0, view | 2 |
| `t` | camera pose | 0, view | 6 |
| `g` | log scale of a view | 0, view | 1 |
| `m` | map point | point, view | 3 |
| `r` | rigid landmark | landmark, 0 | 3 |
"""

from __future__ import annotations

from typing import SupportsIndex, SupportsInt

FIRST_ORDER = "d"
SECOND_ORDER = "c"
LOG_DEPTH = "b"
LOG_SCALE = "s"
RAY_CORRECTION = "q"
LOG_FACTOR = "f"
LOG_LENGTH = "e"
STRAIN = "h"
CAMERA_POSE = "t"
VIEW_SCALE = "g"
MAP_POINT = "m"
RIGID_LANDMARK = "r"

_NAMES = {
    FIRST_ORDER: ("first-order terms", "point", "view"),
    SECOND_ORDER: ("second-order terms", "point", "view"),
    LOG_DEPTH: ("log depth", "point", "view"),
    LOG_SCALE: ("log conformal scale", "point", "edge"),
    RAY_CORRECTION: ("ray correction", "point", "view"),
    LOG_FACTOR: ("log conformal factor", "point", "view"),
    LOG_LENGTH: ("log edge length", "mesh edge", None),
    STRAIN: ("homogeneous strain", None, "view"),
    CAMERA_POSE: ("camera pose", None, "view"),
    VIEW_SCALE: ("log view scale", None, "view"),
    MAP_POINT: ("map point", "point", "view"),
    RIGID_LANDMARK: ("rigid landmark", "landmark", None),
}

_FIRST_LIMIT = 1 << 32
_SECOND_LIMIT = 1 << 24


def key(letter: str, first: int, second: int = 0) -> int:
    """Pack a letter and two indices into a GTSAM key that fits a signed 64-bit integer.

    Raises:
        ValueError: the letter is not one ASCII character, or an index is out of range.
    """
    if len(letter) != 1 or not 0 < ord(letter) < 128:
        raise ValueError(f"key letter must be one ASCII character, got {letter!r}")
    if not 0 <= first < _FIRST_LIMIT or not 0 <= second < _SECOND_LIMIT:
        raise ValueError(f"key indices must lie in [0, 2^32) and [0, 2^24), got {first} and {second}")
    return (ord(letter) << 56) | (int(first) << 24) | int(second)


def decode(key: SupportsInt | SupportsIndex) -> tuple[str, int, int]:
    """Letter, first index and second index of a key."""
    key = int(key)
    return chr((key >> 56) & 0xFF), (key >> 24) & (_FIRST_LIMIT - 1), key & (_SECOND_LIMIT - 1)


def describe(key: SupportsInt | SupportsIndex) -> str:
    """The key in words, e.g. ``log depth of point 12, view 3``; use it as GTSAM's key formatter."""
    letter, first, second = decode(key)
    if letter not in _NAMES:
        return f"{letter}({first}, {second})"
    name, first_name, second_name = _NAMES[letter]
    where = [f"{noun} {index}" for noun, index in ((first_name, first), (second_name, second)) if noun is not None]
    return f"{name} of {', '.join(where)}"
