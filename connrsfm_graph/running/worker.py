"""A worker process, `python -m connrsfm_graph.running.worker`: a guide and then blocks on its standard input.

Both ends are this package, on one machine and of one user, so that what goes through the pipes may be pickled.
"""

from __future__ import annotations

import os
import pickle
import sys
import traceback
from typing import BinaryIO


def serve(requests: BinaryIO, answers: BinaryIO) -> None:
    """Answer every block with a `Finished`, or the error that it ended with, until the requests end."""
    from connrsfm_graph.running.block import work_on

    answer: object
    guide = pickle.load(requests)
    while True:
        try:
            block = pickle.load(requests)
        except EOFError:
            return
        try:
            answer = work_on(guide, block)
        except Exception as error:
            error.add_note(traceback.format_exc())
            answer = error
        pickle.dump(answer, answers, protocol=pickle.HIGHEST_PROTOCOL)
        answers.flush()


if __name__ == "__main__":
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever prints must not disturb the answers
    try:
        serve(sys.stdin.buffer, answers)
    except (EOFError, BrokenPipeError, pickle.UnpicklingError):  # whoever asked is gone
        os._exit(1)
