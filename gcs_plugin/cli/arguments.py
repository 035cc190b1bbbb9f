"""What verbs have in common: arguments that fill a dataclass, `--config`, files to be kept, progress bars."""

import argparse
import os
import sys
import time
from collections.abc import Iterable, Mapping
from dataclasses import fields
from pathlib import Path
from types import TracebackType
from typing import Any, Final

from orthoswarm.model.errors import InputError
from orthoswarm.stores.addresses import address_of, is_stored


def same_file(one: Path, other: Path) -> bool:
    """Whether two paths are one file, which need not exist, by whatever links."""
    if is_stored(one) or is_stored(other):
        return one == other
    try:
        return os.path.samefile(one, other)
    except OSError:
        return os.path.normcase(os.path.realpath(one)) == os.path.normcase(os.path.realpath(other))


def refuse_replacing(flag: str, target: Path, inputs: Mapping[str, Path | None]) -> None:
    """Refuse to write a file over an input.

    Args:
        flag: that names the target. target: file to be written. inputs: name of each input -> its path, None without.

    Raises:
        InputError: they are the same file.
    """
    for name, path in inputs.items():
        if path is not None and same_file(target, path):
            raise InputError(f"{flag} {address_of(target)} would replace {name}; choose another name")


def refuse_product(name: str, path: Path, out: Path, products: Iterable[str]) -> None:
    """Refuse a file that is a product of the output folder, or lies in a folder that is one.

    Raises:
        InputError: it is one.
    """
    for product in products:
        own = out / product
        if any(same_file(p, own) for p in (path, path.parent, path.parent.parent)):
            raise InputError(
                f"{name} {address_of(path)} is the run's own {product}; choose another name or another --out"
            )


def require_folder_for(flag: str, target: Path) -> None:
    """Refuse a file to be written where no file can be made, before the work.

    Raises:
        InputError: its folder does not exist or cannot be written, or it is a folder itself.
    """
    if target.is_dir():
        raise InputError(f"{flag} {target} is a folder; name a file in it")
    if not target.parent.is_dir():
        raise InputError(f"{flag} {target}: there is no folder {target.parent}; make it first, or choose another")
    if not os.access(target.parent, os.W_OK):
        raise InputError(f"{flag} {target} cannot be written; choose another folder")


def require_no_file(flag: str, folder: Path) -> None:
    """Refuse a folder for products that is a file, or lies below one; raises InputError: it is."""
    blocked = next((p for p in (folder, *folder.parents) if p.exists() and not p.is_dir()), None)
    if blocked is not None:
        raise InputError(f"{flag} {folder}: {blocked} is a file; choose a folder")


def add_config(parser: argparse.ArgumentParser) -> None:
    """Add the argument."""
    parser.add_argument("--config", type=Path, metavar="FILE.toml", help="settings other than usual (docs/usage.md)")


def given(args: argparse.Namespace, options: type[Any]) -> dict[str, Any]:
    """The arguments that are fields of a dataclass; without those that were not given, for which it has defaults."""
    values = {field.name: getattr(args, field.name, None) for field in fields(options)}
    return {name: value for name, value in values.items() if value is not None}


_LINE_S: Final = 5.0


class ProgressBars:
    """One bar per stage; call it with stage, number done and total."""

    def __init__(self) -> None:
        self._bars: Any = None
        self._tasks: dict[str, Any] = {}
        self._shown = time.monotonic()

    def __enter__(self) -> "ProgressBars":
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

            self._bars = Progress(
                TextColumn("{task.description:<24}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeRemainingColumn(elapsed_when_finished=True),
                console=Console(stderr=True),
                auto_refresh=False,  # its thread would keep workers from being forked, see cheapest_context
            )
            self._bars.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, value: BaseException | None, at: TracebackType | None) -> None:
        if self._bars is not None:
            self._bars.stop()

    def __call__(self, what: str, done: int, total: int) -> None:
        """Show progress."""
        now = time.monotonic()
        if self._bars is None:
            if done >= total > 0 and what not in self._tasks:
                self._tasks[what] = True
                print(f"{what}: {total}", file=sys.stderr, flush=True)
            elif done < total and now - self._shown > _LINE_S:
                self._shown = now
                print(f"{what}: {done} of {total}", file=sys.stderr, flush=True)
            return
        if what not in self._tasks:
            self._tasks[what] = self._bars.add_task(what, total=total)
        elif now - self._shown < 0.1 and done < total:
            return
        self._shown = now
        self._bars.update(self._tasks[what], completed=done, total=total, refresh=True)
