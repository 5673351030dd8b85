"""The two ways a run can end badly. Both carry one sentence meant for the user."""

from __future__ import annotations


class InputError(ValueError):
    """The input cannot be used. The message names the file or field and what was expected (exit status 2)."""


class ComputationError(RuntimeError):
    """The input is fine but the computation failed (exit status 1)."""


def missing_package(what: str, package: str, extra: str) -> InputError:
    """What needs a package that is not installed, and the extra of this project that brings it."""
    return InputError(
        f"{what} needs {package}, which is not installed; install the extra '{extra}': pip install '.[{extra}]' in the "
        "project's folder"
    )
