"""`--config`, the same for every verb that has it: settings other than usual."""

import argparse
from pathlib import Path


def add_config(parser: argparse.ArgumentParser) -> None:
    """Add the argument."""
    parser.add_argument("--config", type=Path, metavar="FILE.toml", help="settings other than usual (docs/usage.md)")
