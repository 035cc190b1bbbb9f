"""The `orthoswarm` command: finds the verb, imports only that verb's module, maps errors to exit codes."""

import _thread
import argparse
import importlib
import io
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import Any

import orthoswarm
from orthoswarm import __version__
from orthoswarm.model.errors import OrthoSwarmError

# verb -> one line of help; its module in gcs_plugin.cli.verbs has configure(parser) and run(args) -> int.
VERBS = {
    "plan": "make missions that cover an area, or follow lines, with a swarm",
    "basemap": "fetch a map of an area from a tile server, for use without internet",
    "mosaic": "make a georeferenced orthoimage from drone photos",
    "coverage": "say which ground of an area was seen well, what was missed, and why",
    "change": "say where the ground is no longer what the pre-disaster map shows, and what has become of it",
    "inspect": "say what photos, videos and logs contain, and what is suspicious about them",
    "frames": "take the pictures of a video, with their poses in EXIF and XMP",
    "fleet": "list vehicles on their links, upload missions, start, pause, resume, bring home, watch",
    "sim": "run simulated vehicles that speak MAVLink",
    "demo": "a simulated swarm, end to end, no files and no autopilot needed",
    "serve": "run the daemon: the map grows in the browser while vehicles fly, and is refined as they complete",
    "export": "write a map in the formats of other programs (MBTiles, KMZ, GeoPackage, OpenDroneMap, COG)",
    "twin": "make a set of photos, map and truth of a digital twin city",
    "evaluate": "measure an orthoimage against a reference, and poses against truth",
    "bench": "measure accuracy and cost on sets with truth, and how cost grows with vehicles and pictures",
    "weights": "list, import and check the weights of learned matchers",
    "doctor": "show what this machine has (codecs, weights, cores, disk), and what does not work without the rest",
}
_FOLDERS = dict.fromkeys(("basemap", "change", "coverage"), "ground.")
"""Where a verb's module lies, if not beside the others."""

_NEGATIVE = re.compile(r"-[0-9.]")
_INTERRUPT_AGAIN_S = 0.05  # well below what a person notices
_NOT_INTERRUPTED = ("numba", "llvmlite")  # compile and call back from C
_IMPORT_CODE = "<frozen importlib"


class _Parser(argparse.ArgumentParser):
    """A parser whose help keeps the lines of its examples, as those of its actions do."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(**settings, formatter_class=argparse.RawDescriptionHelpFormatter)


def _overview() -> str:
    width = max(map(len, VERBS))
    lines = [
        "usage: orthoswarm [--version] VERB ...",
        "",
        "Georeferenced orthoimagery from swarms of uncalibrated drones.",
        "",
        "verbs:",
        *(f"  {name:<{width}}  {text}" for name, text in VERBS.items()),
        "",
        "`orthoswarm VERB --help` explains a verb and shows an example.",
    ]
    return "\n".join(lines)


def _commit() -> str:
    """The commit in brackets: as the package was built with, or as git describes the checkout; else nothing."""
    package = Path(orthoswarm.__file__).parent
    with suppress(OSError):
        return f" ({(package / 'commit.txt').read_text(encoding='utf-8').strip()})"
    if not (package.parent / ".git").exists():
        return ""
    describe = ["git", "describe", "--always", "--dirty", "--exclude=*"]
    with suppress(OSError):  # a machine without git
        told = subprocess.run(describe, cwd=package.parent, capture_output=True, text=True, check=False).stdout.strip()
        return f" ({told})" if told else ""
    return ""


def _open_streams() -> None:
    """Make sure that printing never fails.

    A closed stream is replaced by the null device; otherwise a product could get its file number, and with it what
    libraries print. Characters that a console does not have are written as escapes.
    """
    for name in ("stdin", "stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, "r" if name == "stdin" else "w", encoding="utf-8"))  # noqa: SIM115
        elif isinstance(stream, io.TextIOWrapper) and stream.writable():
            stream.reconfigure(errors="backslashreplace")


def _join_negative_values(args: Sequence[str]) -> list[str]:
    """`--start -35.36,149.17` as `--start=-35.36,149.17`: argparse takes a value with a leading minus for a flag."""
    joined: list[str] = []
    for argument in args:
        flag = joined[-1] if joined else ""
        if _NEGATIVE.match(argument) and flag.startswith("--") and "=" not in flag and flag != "--":
            joined[-1] = f"{flag}={argument}"
        else:
            joined.append(argument)
    return joined


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code (0 made, 1 nothing could be made, 2 wrong input, 130 interrupted)."""
    _open_streams()
    args = list(sys.argv[1:] if argv is None else argv)
    if not args or args[0] in ("-h", "--help"):
        print(_overview())
        return 0 if args else 2
    if args[0] == "--version":
        print(f"orthoswarm {__version__}{_commit()}")
        return 0
    verb = args[0]
    if verb not in VERBS:
        print(f"orthoswarm: there is no verb '{verb}'; choose one of: {', '.join(VERBS)}", file=sys.stderr)
        return 2
    module = importlib.import_module(f"gcs_plugin.cli.verbs.{_FOLDERS.get(verb, '')}{verb}")
    parser = _Parser(prog=f"orthoswarm {verb}", description=VERBS[verb][0].upper() + VERBS[verb][1:] + ".")
    module.configure(parser)
    try:
        parsed = parser.parse_args(_join_negative_values(args[1:]))
    except SystemExit as stop:
        return int(stop.code or 0)
    if getattr(parsed, "json", False) and isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(encoding="utf-8", errors="backslashreplace")  # JSON is UTF-8
    try:
        with safe_interrupts():
            return int(module.run(parsed))
    except OrthoSwarmError as error:
        print(f"orthoswarm: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("orthoswarm: interrupted; run the same command again to go on", file=sys.stderr)
        return 130
    except BrokenPipeError:
        return 0


@contextmanager
def safe_interrupts() -> Iterator[None]:
    """Within it SIGINT raises KeyboardInterrupt as always, but not amid a compilation or an import: right after it.

    KeyboardInterrupt appears between any two lines, also of a library that a C library calls back (the exception is
    then printed and lost, and the program goes on), of a compiler that leaves its work half done (numba fails with
    another error), and of an import (NumPy answers with an ImportError). Such a moment is waited out.

    It does nothing outside the main thread, and where SIGINT is ignored or handled by somebody else.
    """
    main_thread = threading.current_thread() is threading.main_thread()
    if not main_thread or signal.getsignal(signal.SIGINT) is not signal.default_int_handler:
        yield
        return
    again: list[threading.Timer] = []

    def interrupt(_number: int, frame: FrameType | None) -> None:
        if _may_raise(frame):
            raise KeyboardInterrupt
        again[:] = [threading.Timer(_INTERRUPT_AGAIN_S, _interrupt_main_thread)]
        again[0].daemon = True
        again[0].start()

    signal.signal(signal.SIGINT, interrupt)
    try:
        yield
    finally:
        for timer in again:
            timer.cancel()
        if signal.getsignal(signal.SIGINT) is interrupt:
            signal.signal(signal.SIGINT, signal.default_int_handler)


def _may_raise(frame: FrameType | None) -> bool:
    while frame is not None:
        module = str(frame.f_globals.get("__name__", "")).partition(".")[0]
        if module in _NOT_INTERRUPTED or frame.f_code.co_filename.startswith(_IMPORT_CODE):
            return False
        frame = frame.f_back
    return True


def _interrupt_main_thread() -> None:
    if hasattr(signal, "pthread_kill"):  # it also ends a system call that waits
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    else:
        _thread.interrupt_main()


if __name__ == "__main__":
    sys.exit(main())
