"""Progress bars with the time left, on stderr; where that is no terminal, a line every few seconds and per stage."""

import sys
import time
from types import TracebackType
from typing import Any, Final

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
