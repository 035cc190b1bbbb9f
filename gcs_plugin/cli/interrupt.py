"""Ctrl-C, raised only where Python code can pass it on.

`KeyboardInterrupt` appears between any two lines, also of a library that a C library calls back (the exception is then
printed and lost, and the program goes on), of a compiler that leaves its work half done (numba fails with another
error), and of an import (NumPy answers with an ImportError). Such a moment is waited out.
"""

import _thread
import signal
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

_AGAIN_S = 0.05  # well below what a person notices
_LIBRARIES = ("numba", "llvmlite")  # compile and call back from C
_IMPORTS = "<frozen importlib"


@contextmanager
def safe_interrupts() -> Iterator[None]:
    """Within it SIGINT raises KeyboardInterrupt as always, but not amid a compilation or an import: right after it.

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
        again[:] = [threading.Timer(_AGAIN_S, _interrupt_main_thread)]
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
        if module in _LIBRARIES or frame.f_code.co_filename.startswith(_IMPORTS):
            return False
        frame = frame.f_back
    return True


def _interrupt_main_thread() -> None:
    if hasattr(signal, "pthread_kill"):  # it also ends a system call that waits
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)
    else:
        _thread.interrupt_main()
