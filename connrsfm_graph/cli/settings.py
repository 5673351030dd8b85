"""Print all settings with their help as TOML, a start for a file to give with --config."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from connrsfm_graph.reconstruct import Config


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_configuration(parser)


def run(arguments: argparse.Namespace) -> None:
    from connrsfm_graph.config import as_toml

    print(as_toml(resolved(arguments)), end="")


def add_configuration(parser: argparse.ArgumentParser) -> None:
    """The options that make a configuration, shared by all commands that reconstruct."""
    parser.add_argument(
        "--mode",
        choices=("default", "paper"),
        default="default",
        help="settings to start from: the best known, or the published algorithm as written (default: %(default)s)",
    )
    parser.add_argument("--config", type=Path, metavar="TOML", help="file of settings; those it lacks keep their value")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="one setting, such as refine.iterations=50; may be repeated (connrsfm settings lists all)",
    )
    parser.add_argument("--seed", type=int, help="seed of every random choice")


def resolved(arguments: argparse.Namespace) -> Config:
    """The configuration these options mean: mode, then file, then single settings."""
    from connrsfm_graph.config import override, read_toml
    from connrsfm_graph.reconstruct import default_config

    config = default_config(arguments.mode)
    if arguments.config is not None:
        config = read_toml(config, arguments.config)
    config = override(config, arguments.set)
    return config if arguments.seed is None else override(config, [f"seed={arguments.seed}"])
