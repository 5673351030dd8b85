"""Shared fixtures."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

# Small matrices gain nothing from threads of BLAS; set before numpy is loaded.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Time limits per example say more about the machine than about the code; compiled kernels make the first one slow.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture
def realdata() -> Callable[[str], Path]:
    """Path of a real data set, or a skip that says which file is missing."""

    def find(name: str) -> Path:
        path = DATA / name
        if not path.exists():
            pytest.skip(f"real data set {name} is not at {DATA}")
        return path

    return find
