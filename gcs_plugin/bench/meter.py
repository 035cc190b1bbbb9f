"""Run a command with a limit and measure all its processes together: CPU time, memory, wall time.

Linux only: the processes are found in /proc by their session id.
"""

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from orthoswarm.model.errors import InputError

_PROC = Path("/proc")
_EVERY_S = 0.25
_WALL_FACTOR = 20.0  # a program may wait so many times its limit of CPU time


@dataclass(frozen=True, slots=True)
class Measured:
    """Resources that a command used.

    Attributes:
        code: exit code, None if it was stopped at the limit.
        wall_s: wall time, seconds. cpu_s: CPU seconds of all its processes.
        peak_rss_mb: largest sum of their resident sizes, megabytes; pages that they share count for each.
    """

    code: int | None
    wall_s: float
    cpu_s: float
    peak_rss_mb: float


def run_measured(
    command: Sequence[str], log: Path, limit_s: float, env: Mapping[str, str] | None = None, out: Path | None = None
) -> Measured:
    """Run a command to its end or to its limit.

    Args:
        command: program and arguments.
        log: where its stderr goes (and its stdout, without `out`).
        limit_s: CPU seconds that all its processes may use; it is also stopped after twenty times as much wall time.
            CPU time, since other work on the machine does not change it.
        env: variables in addition to those of this process.
        out: where its stdout goes.

    Raises:
        InputError: where there is no /proc.
    """
    if not (_PROC / "self" / "stat").exists():
        raise InputError("other programs can only be measured on Linux; run this benchmark there")
    start, used, memory = time.monotonic(), 0.0, 0.0
    with contextlib.ExitStack() as stack:
        errors = stack.enter_context(log.open("wb"))
        output = stack.enter_context(out.open("wb")) if out else errors
        process = subprocess.Popen(
            command, stdout=output, stderr=errors, env={**os.environ, **(env or {})}, start_new_session=True
        )
        stopped, ended = False, 0
        try:
            while not ended:
                cpu_s, rss_mb = session_usage(process.pid)
                used, memory = max(used, cpu_s), max(memory, rss_mb)
                if used > limit_s or time.monotonic() - start > _WALL_FACTOR * limit_s:
                    stopped = True
                    os.killpg(process.pid, signal.SIGKILL)
                ended, status, usage = os.wait4(process.pid, 0 if stopped else os.WNOHANG)
                if not ended:
                    time.sleep(_EVERY_S)
            process.returncode = os.waitstatus_to_exitcode(status)
        finally:
            with contextlib.suppress(ProcessLookupError, PermissionError):  # remaining child processes, or Ctrl-C
                os.killpg(process.pid, signal.SIGKILL)
    used = max(used, usage.ru_utime + usage.ru_stime)
    if not memory:  # it ended before the first look; the kernel's figure is an upper bound, since it
        memory = usage.ru_maxrss / 1024.0  # counts what the process that starts a program held at that time, too
    return Measured(None if stopped else process.returncode, time.monotonic() - start, used, memory)


def session_usage(session: int) -> tuple[float, float]:
    """CPU seconds and resident megabytes of a session's living processes, with the CPU time of their ended children."""
    ticks, page = os.sysconf("SC_CLK_TCK"), os.sysconf("SC_PAGE_SIZE")
    cpu, pages = 0, 0
    for entry in _PROC.iterdir():
        if not entry.name.isdigit():
            continue
        try:
            # the process name may contain spaces and brackets; the fields follow its last closing bracket
            fields = (entry / "stat").read_text(encoding="ascii", errors="replace").rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[3]) == session:
            cpu += sum(map(int, fields[11:15]))
            pages += int(fields[21])
    return cpu / ticks, pages * page / 1e6
