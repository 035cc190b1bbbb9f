"""Every module can be imported where the modules and functions that only POSIX systems have are absent."""

import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
# Other packages are imported first: what they need of the system is theirs.
SCRIPT = """
import builtins, importlib, os, pathlib, signal, sys
import asyncio, multiprocessing.resource_tracker, multiprocessing.popen_spawn_posix, subprocess  # noqa
ours = ("orthoswarm", "telemetry", "gcs_plugin")
names = [
    ".".join(path.with_suffix("").parts).removesuffix(".__init__")
    for package in ours for path in sorted(pathlib.Path(package).rglob("*.py")) if path.name != "__main__.py"
]
hidden = {"fcntl", "resource", "termios", "pwd", "grp", "pty", "tty", "syslog"}
whole = builtins.__import__
def guarded(name, globals=None, *rest):
    if name in hidden and (globals or {}).get("__name__", "").split(".")[0] in ours:
        raise ImportError(f"{name} is hidden")
    return whole(name, globals, *rest)
for name in list(names):
    try:
        importlib.import_module(name)
    except ImportError:  # an extra that is not installed
        names.remove(name)
assert len(names) > 500
for name in [name for name in sys.modules if name.split(".")[0] in ours]:
    del sys.modules[name]
builtins.__import__, sys.platform, failed = guarded, "win32", []
for module, gone in ((os, "killpg nice sysconf wait4 pread preadv writev sched_getaffinity getloadavg statvfs fork"),
                     (signal, "SIGKILL SIGHUP pthread_sigmask setitimer")):
    for name in gone.split():
        delattr(module, name)
for name in names:
    try:
        importlib.import_module(name)
    except (ImportError, AttributeError) as error:
        failed.append(f"{name}: {error}")
print(*failed, sep="\\n")
sys.exit(bool(failed))
"""


def test_all_modules_can_be_imported_without_what_is_posix_only():
    run = subprocess.run([sys.executable, "-c", SCRIPT], cwd=ROOT, capture_output=True, text=True, timeout=800)
    assert run.returncode == 0, run.stdout + run.stderr[-2000:]
