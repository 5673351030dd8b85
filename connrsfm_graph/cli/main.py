"""Entry point of `connrsfm`: which command, and how a run ends.

Exit status 0 on success, 2 on bad usage or bad input, 1 where the computation failed, 130 where it was interrupted;
whatever went wrong is one sentence on standard error.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from typing import NoReturn

from connrsfm_graph.cli import demo, densify, evaluate, reconstruct, report, settings, slam, track, train_depth
from connrsfm_graph.errors import ComputationError, InputError

COMMANDS = (demo, track, reconstruct, slam, densify, evaluate, report, train_depth, settings)


def main(argv: Sequence[str] | None = None) -> int:
    """Run `connrsfm` with these arguments (the process's own where None) and return the exit status."""
    # Read when numpy is loaded, which the commands do: many small matrices gain nothing from threads of BLAS.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        arguments = build_parser().parse_args(argv)
    except SystemExit as stop:  # argparse has printed help or what is wrong
        return int(stop.code or 0)
    except KeyboardInterrupt:
        return 130
    try:
        arguments.run(arguments)
    except InputError as error:
        return _ended(arguments, str(error), 2)
    except ComputationError as error:
        return _ended(arguments, str(error), 1)
    except OSError as error:
        return _ended(arguments, f"{error.filename or 'file'}: {error.strerror or error}", 2)
    except KeyboardInterrupt:
        return _ended(arguments, "interrupted; unfinished results were removed", 130)
    except Exception as error:
        told = " ".join(str(error).split())
        hint = "" if arguments.debug else " (--debug shows where)"
        return _ended(arguments, f"unexpected {type(error).__name__}: {told}{hint}", 1)
    return 0


class _Parser(argparse.ArgumentParser):
    """Says what is wrong in one sentence instead of printing the usage first."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {message}; see {self.prog} --help\n")


def build_parser() -> argparse.ArgumentParser:
    """All commands and their options."""
    parser = _Parser(
        prog="connrsfm",
        description="Surface of every image of a deforming object, and the conformal scale between images, from point "
        "tracks.",
        epilog="Try it without any data: connrsfm demo --out demo",
    )
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", dest="command", required=True)
    for command in COMMANDS:
        name = command.__name__.rpartition(".")[2].replace("_", "-")
        summary = (command.__doc__ or "").partition("\n")[0]
        sub = commands.add_parser(name, help=summary.rstrip("."), description=summary)
        command.add_arguments(sub)
        sub.add_argument("--debug", action="store_true", help="show the traceback of an error")
        sub.set_defaults(run=command.run)
    return parser


def _ended(arguments: argparse.Namespace, sentence: str, status: int) -> int:
    if arguments.debug:
        import traceback

        traceback.print_exc()
    print(f"connrsfm {arguments.command}: {sentence}", file=sys.stderr)
    return status
