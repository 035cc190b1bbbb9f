"""Compiles the product's kernels into the package: `python -m orthoswarm.compute.compile_kernels`.

What was compiled before stays unless something changed that goes into it. `signatures.txt` lists the kernels that
Python calls and the types of their arguments, a line each; what they call comes with them. A test runs the product and
shows that nothing is missing there (`tests/model/test_compiled_kernels.py`).
"""

import importlib
import json
import os
import sys
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Final

Report = Callable[[int, int], None]

SIGNATURES: Final = Path(__file__).with_name("signatures.txt")
MADE_FOR: Final = Path(__file__).with_name("compiled") / "made_for.json"
_PROCESSES: Final = 2  # the longest module takes a quarter of all the time: more would wait for it


def listed() -> dict[str, list[str]]:
    """The lines "kernel types" of each module that has kernels that are called from Python."""
    lines: dict[str, list[str]] = defaultdict(list)
    for line in SIGNATURES.read_text(encoding="utf-8").splitlines():
        module, kernel = line.split(" ", 1)
        lines[f"orthoswarm.{module}"].append(kernel)
    return dict(lines)


def load_kernels(*rooms: str) -> None:
    """Load the kernels of rooms ("mosaic.kernels") before they are needed, where the installation has them compiled."""
    from numba.core.sigutils import normalize_signature

    ours = tuple(f"orthoswarm.{room}." for room in rooms) if MADE_FOR.exists() else ()
    for module, lines in listed().items():
        for name, types in (line.split(" ", 1) for line in lines if module.startswith(ours)):
            getattr(importlib.import_module(module), name).compile(normalize_signature(f"({types},)")[0])


def missing() -> tuple[int, int]:
    """How many of the listed kernels are not compiled yet, and how many there are."""
    lines = [(module, line) for module, lines in listed().items() for line in lines]
    return sum(_to_compile(module, line) is not None for module, line in lines), len(lines)


def compile_all(report: Report) -> int:
    """Compile what is missing, in two processes, into the package or, if that is read-only, numba's cache folder.

    Args:
        report: called with the number of kernels that are there and that of all.

    Returns:
        How many were compiled.
    """
    from orthoswarm.compute.workers import prepare_worker, starting_processes

    modules = listed()
    done, total, compiled = 0, sum(map(len, modules.values())), 0
    report(0, total)
    processes = min(_PROCESSES, os.cpu_count() or 1)
    with ProcessPoolExecutor(processes, get_context("spawn"), initializer=prepare_worker) as pool:
        # Those with most arguments first, so that no process is left with a long one at the end.
        order = sorted(modules, key=lambda module: -sum(map(len, modules[module])))
        with starting_processes():
            running = {pool.submit(_compile, module, modules[module]): module for module in order}
        try:
            for task in as_completed(running):
                compiled += task.result()
                done += len(modules[running[task]])
                report(done, total)
        except BaseException:  # what is being compiled is finished, the rest is not begun
            pool.shutdown(wait=False, cancel_futures=True)
            raise
        if compiled or not MADE_FOR.exists():
            pool.submit(_tidy, order).result()
    return compiled


def main() -> None:
    """Compile, and say how far it is; say nothing where all is compiled into the package."""
    _save_in_package()
    if not missing()[0] and MADE_FOR.exists():
        return
    tenths = set()

    def say(done: int, total: int) -> None:
        if (tenth := 10 * done // total) not in tenths:
            tenths.add(tenth)
            print(f"compiling the kernels: {done} of {total}", file=sys.stderr, flush=True)

    compile_all(say)


def _save_in_package() -> None:
    """Have this process look for kernels in the package alone and save them there, if it can be written."""
    from orthoswarm.compute.kernel_cache import FOLDER, KernelCache

    KernelCache.filling = os.access(FOLDER if FOLDER.exists() else FOLDER.parent, os.W_OK)


def _compile(module: str, lines: list[str]) -> int:
    _save_in_package()
    importlib.import_module(module)
    _spare_inner()
    wanted = [found for line in lines if (found := _to_compile(module, line))]
    for kernel, types in wanted:
        kernel.compile(types)
    return len(wanted)


def _spare_inner() -> None:
    """Have kernels that only kernels call compiled into the package without a function for Python, until `_tidy`."""
    from orthoswarm.compute.kernel_cache import KernelCache

    called = {f"{module}.{line.split(' ', 1)[0]}" for module, lines in listed().items() for line in lines}
    for kernel in _kernels() if KernelCache.filling else []:
        name = f"{kernel.py_func.__module__}.{kernel.py_func.__name__}"
        if name not in called and not _is_inner(kernel):
            kernel.targetoptions["no_cpython_wrapper"] = True
            kernel._cache.keep_inner()


def _is_inner(kernel: Any) -> bool:
    return "no_cpython_wrapper" in kernel.targetoptions


def _kernels() -> list[Any]:
    """All kernels of modules that are imported."""
    from numba.core.dispatcher import Dispatcher

    ours = [vars(module).values() for name, module in sys.modules.items() if name.startswith("orthoswarm.")]
    return [value for values in ours for value in values if isinstance(value, Dispatcher)]


def _to_compile(module: str, line: str) -> tuple[Any, Any] | None:
    """A kernel and the types of its arguments, None if it is compiled."""
    from numba.core.sigutils import normalize_signature

    name, types = line.split(" ", 1)
    kernel = getattr(importlib.import_module(module), name)
    arguments, _ = normalize_signature(f"({types},)")
    return None if kernel._cache.has(arguments, kernel.targetctx.codegen()) else (kernel, arguments)


def _tidy(modules: list[str]) -> None:
    """Remove the files of kernels that have changed or are gone, and write what a wheel of the others needs."""
    import numba

    from orthoswarm.compute.kernel_cache import FOLDER, KernelCache

    for name in modules:
        importlib.import_module(name)
    kept = set().union(*(kernel._cache.files() for kernel in _kernels() if not _is_inner(kernel)))
    for file in FOLDER.rglob("*.nb[ci]"):
        if file not in kept:
            file.unlink(missing_ok=True)
    if KernelCache.filling:
        made = {"numba": numba.__version__, "python": sys.version_info[:2], "processor": numba.config.CPU_NAME}
        MADE_FOR.write_text(json.dumps(made), encoding="utf-8")


if __name__ == "__main__":
    main()
