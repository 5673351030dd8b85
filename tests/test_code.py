"""The code as a whole: linter, type checker, and what importing it costs."""

from __future__ import annotations

import importlib
import pkgutil
import subprocess
import sys
from pathlib import Path

import pytest
from numba.core.dispatcher import Dispatcher

ROOT = Path(__file__).resolve().parents[1]


def _run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, *arguments], cwd=ROOT, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("arguments", [("check", "."), ("format", "--check", ".")], ids=["check", "format"])
def test_ruff(arguments):
    done = _run("-m", "ruff", *arguments)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_types():
    done = _run("-m", "mypy")
    assert done.returncode == 0, done.stdout + done.stderr


def test_import_is_quick_and_brings_no_heavy_package():
    code = (
        "import time; start = time.perf_counter(); import sys, factors, connrsfm_graph;"
        "assert time.perf_counter() - start < 1.0;"
        "heavy = {'torch', 'cv2', 'matplotlib'} & set(sys.modules); assert not heavy, heavy"
    )
    done = _run("-c", code)
    assert done.returncode == 0, done.stderr


def test_factors_do_not_know_the_pipeline():
    code = (
        "import importlib, pkgutil, sys, factors;"
        "[importlib.import_module(f'factors.{m.name}') for m in pkgutil.iter_modules(factors.__path__)];"
        "heavy = {'connrsfm_graph', 'cv2', 'networkx', 'torch', 'matplotlib'} & set(sys.modules);"
        "assert not heavy, heavy"
    )
    done = _run("-c", code)
    assert done.returncode == 0, done.stderr


def test_no_compiled_code_reorders_sums():
    """Its bits would depend on which parts of it came from the cache, and so differ between workers."""
    found = []
    for package in ("connrsfm_graph", "factors"):
        for module in pkgutil.walk_packages([str(ROOT / package)], f"{package}."):
            if not module.name.endswith("__main__"):
                found += [
                    item for item in vars(importlib.import_module(module.name)).values() if isinstance(item, Dispatcher)
                ]
    assert len(found) > 50
    assert not [function.__name__ for function in found if function.targetoptions.get("fastmath")]
