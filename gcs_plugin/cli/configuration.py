"""`--config`, the same for every verb that has it: thresholds of any stage other than their defaults."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from orthoswarm.config import Overrides


def add_config(parser: argparse.ArgumentParser) -> None:
    """Add the argument."""
    parser.add_argument(
        "--config", type=Path, metavar="FILE.toml", help="thresholds of any stage other than their defaults"
    )


def read_config(path: Path | None) -> "Overrides":
    """The overrides of the file, none without one.

    Raises:
        InputError: the file cannot be read, or holds something else.
    """
    from orthoswarm.config import read_overrides

    return {} if path is None else read_overrides(path)


def use_config(path: Path | None) -> "Overrides":
    """Put the file's overrides in force in this process, before anything reads a value; returns them.

    Raises:
        InputError: the file cannot be read, or holds something else.
    """
    from orthoswarm.config import override

    values = read_config(path)
    override(values)
    return values
