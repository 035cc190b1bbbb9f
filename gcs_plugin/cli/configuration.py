"""Arguments that fill a dataclass, and `--config`, the same for every verb that has it."""

import argparse
from dataclasses import fields
from pathlib import Path
from typing import Any


def add_config(parser: argparse.ArgumentParser) -> None:
    """Add the argument."""
    parser.add_argument("--config", type=Path, metavar="FILE.toml", help="settings other than usual (docs/usage.md)")


def given(args: argparse.Namespace, options: type[Any]) -> dict[str, Any]:
    """The arguments that are fields of a dataclass; without those that were not given, for which it has defaults."""
    values = {field.name: getattr(args, field.name, None) for field in fields(options)}
    return {name: value for name, value in values.items() if value is not None}
