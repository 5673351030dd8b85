"""Progress of a run: seconds per stage for the record, and one living line on standard error for a person."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

_BAR_WIDTH = 24
_SECONDS_BETWEEN_DRAWS = 0.1


class Progress:
    """Times the stages of a run; draws them only where `stream` is a terminal."""

    def __init__(self, stream: TextIO | None = None) -> None:
        """Draw on `stream`, standard error where None; nothing is written where it is not a terminal."""
        self.seconds: dict[str, float] = {}
        """Wall-clock seconds of each stage so far, in order of first start; a stage inside another counts in both."""
        self._stream = sys.stderr if stream is None else stream
        self._drawing = self._stream.isatty()
        self._stages: list[tuple[str, float]] = []
        self._last_draw = 0.0

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage and show it while it runs; a repeated name adds up."""
        started = time.perf_counter()
        self.seconds.setdefault(name, 0.0)
        self._stages.append((name, started))
        self._draw(name)
        try:
            yield
        except BaseException:
            self._end_line()
            raise
        finally:
            taken = time.perf_counter() - started
            self.seconds[name] += taken
            self._stages.pop()
        self._draw(f"{name:<{_BAR_WIDTH}} {taken:7.1f} s")
        self._end_line()

    def update(self, done: int, total: int) -> None:
        """Show that `done` of `total` parts of the current stage are finished."""
        now = time.perf_counter()
        if not (self._drawing and self._stages) or (done < total and now - self._last_draw < _SECONDS_BETWEEN_DRAWS):
            return
        self._last_draw = now
        name, started = self._stages[-1]
        filled = _BAR_WIDTH * done // max(total, 1)
        bar = "█" * filled + "░" * (_BAR_WIDTH - filled)
        self._draw(f"{name:<{_BAR_WIDTH}} {now - started:7.1f} s  {bar} {done}/{total}")

    def _draw(self, text: str) -> None:
        if self._drawing:
            self._stream.write(f"\r\x1b[K{text}")
            self._stream.flush()

    def _end_line(self) -> None:
        if self._drawing:
            self._stream.write("\n")
            self._stream.flush()
