"""Progress is timed always and drawn only on a terminal."""

from __future__ import annotations

import io

import pytest

from connrsfm_graph.progress import Progress


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def run(progress: Progress) -> None:
    for name in ("warps", "solve", "warps"):
        with progress.stage(name):
            progress.update(1, 2)
            progress.update(2, 2)


def test_silent_where_not_a_terminal() -> None:
    stream = io.StringIO()
    progress = Progress(stream)
    run(progress)
    assert stream.getvalue() == ""
    assert list(progress.seconds) == ["warps", "solve"]
    assert all(seconds > 0 for seconds in progress.seconds.values())


def test_drawn_on_a_terminal() -> None:
    stream = Terminal()
    run(Progress(stream))
    assert stream.getvalue().count("\n") == 3
    assert "2/2" in stream.getvalue()


def test_failed_stage_is_timed_and_ends_its_line() -> None:
    stream = Terminal()
    progress = Progress(stream)

    def failing() -> None:
        with progress.stage("solve"):
            raise RuntimeError

    with pytest.raises(RuntimeError):
        failing()
    assert progress.seconds["solve"] > 0
    assert stream.getvalue().endswith("\n")
    progress.update(1, 2)  # outside a stage: nothing to draw
