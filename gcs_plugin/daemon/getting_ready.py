"""An installation without compiled kernels compiles them as the daemon starts, while that serves and keeps pictures."""

import subprocess
import sys
import threading
from typing import Final

from gcs_plugin.daemon.store.daemon_events import Events
from orthoswarm.compute.compile_kernels import MADE_FOR

_COMMAND: Final = (sys.executable, "-m", "orthoswarm.compute.compile_kernels")
_MEANWHILE: Final = "pictures are kept, and drawn and refined as soon as it is done"


class GettingReady:
    """Compiles in another process, which ends with this one.

    Attributes:
        problem: how far it is, in words; empty once the daemon is ready.
    """

    def __init__(self, events: Events) -> None:
        self._events, self.problem = events, ""
        self._process: subprocess.Popen[str] | None = None

    def start(self) -> None:
        """Start, unless the installation has its kernels."""
        if MADE_FOR.exists():
            return
        self._process = subprocess.Popen(
            _COMMAND, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
        )
        threading.Thread(target=self._follow, args=(self._process,), name="getting ready", daemon=True).start()

    def close(self) -> None:
        """Stop; what is compiled by then stays."""
        if self._process is not None:
            self._process.terminate()
            self._process.wait()

    def _follow(self, process: "subprocess.Popen[str]") -> None:
        assert process.stderr is not None
        with process.stderr as lines:
            for line in lines:
                self.problem = f"getting ready, {line.strip()}; {_MEANWHILE}"
                self._events.tell("problem", text=self.problem)
        self.problem = ""
        text = "ready" if process.wait() == 0 else "kernels are compiled when they are needed"
        self._events.tell("problem", text=text)
