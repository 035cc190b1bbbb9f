"""Ctrl-C amid code that cannot pass on an exception: it is raised right after it."""

import signal
import subprocess
import sys
import textwrap
import time

import pytest

from gcs_plugin.cli.main import safe_interrupts

COMPILER = "def compile(raise_signal, sleep):\n    raise_signal()\n    sleep(0.2)\n    return 'compiled'\n"


@pytest.fixture(autouse=True)
def _as_at_a_terminal():
    """What runs behind a shell ignores interrupts."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


def _interrupt() -> None:
    signal.raise_signal(signal.SIGINT)


def test_an_interrupt_waits_until_a_compilation_is_done():
    library = {"__name__": "numba.core.dispatcher"}
    exec(COMPILER, library)
    done = []
    with pytest.raises(KeyboardInterrupt), safe_interrupts():
        done.append(library["compile"](_interrupt, time.sleep))
        time.sleep(10.0)
    assert done == ["compiled"]


def test_an_interrupt_waits_until_an_import_is_done(tmp_path, monkeypatch):
    (tmp_path / "interrupted_import.py").write_text(
        textwrap.dedent("""
        import signal, time
        signal.raise_signal(signal.SIGINT)
        time.sleep(0.2)
        whole = True
        """)
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(KeyboardInterrupt), safe_interrupts():
        import interrupted_import  # type: ignore[import-not-found]

        assert interrupted_import.whole
        time.sleep(10.0)
    assert sys.modules["interrupted_import"].whole


def test_elsewhere_an_interrupt_comes_at_once_and_the_handler_is_put_back():
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt), safe_interrupts():
        _interrupt()
        pytest.fail("not interrupted")
    assert signal.getsignal(signal.SIGINT) is before


def test_an_interrupt_that_came_too_late_interrupts_nothing():
    library = {"__name__": "llvmlite.binding.executionengine"}
    exec(COMPILER, library)
    with safe_interrupts():
        library["compile"](_interrupt, lambda _s: None)
    time.sleep(0.2)


def test_where_interrupts_are_ignored_they_stay_ignored():
    code = (
        "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)\n"
        "from gcs_plugin.cli.main import safe_interrupts\n"
        "with safe_interrupts(): signal.raise_signal(signal.SIGINT)\n"
        "print('went on')"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "went on\n"
