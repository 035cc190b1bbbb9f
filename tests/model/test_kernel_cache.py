"""Compiled kernels on disk are used again until anything changes that was compiled into them."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

_CALLED = """
from numba.core import types
from numba.extending import intrinsic

from orthoswarm.compute.jit import in_place_kernel

SIZE = 3

@in_place_kernel
def add(values):
    for i in range(len(values)):
        values[i] += 10

@intrinsic
def five(typing):
    return types.int64(), lambda context, builder, signature, arguments: context.get_constant(types.int64, 5)
"""
_CALLER = """
import numpy as np
from called import SIZE, add, five

from orthoswarm.compute.jit import kernel

@kernel
def work():
    values = np.zeros(SIZE, np.int64)
    add(values)
    return values.sum() + five()

if __name__ == "__main__":
    import caller
    print(caller.work(), sum(caller.work.stats.cache_hits.values()))
"""


def _run(folder: Path) -> list[int]:
    """What the kernel returned, and whether it came from the disk."""
    path = os.pathsep.join([str(folder), *sys.path])
    done = subprocess.run(
        [sys.executable, folder / "caller.py"], env=os.environ | {"PYTHONPATH": path}, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return [int(word) for word in done.stdout.split()]


@pytest.mark.parametrize(
    ("old", "new", "result"),
    [("SIZE = 3", "SIZE = 4", 45), ("+= 10", "+= 20", 65), ("types.int64, 5)", "types.int64, 6)", 36)],
    ids=["a constant", "a kernel", "vector code"],
)
def test_a_kernel_is_compiled_again_when_what_it_uses_of_another_file_changes(tmp_path, old, new, result):
    (tmp_path / "called.py").write_text(_CALLED)
    (tmp_path / "caller.py").write_text(_CALLER)
    assert _run(tmp_path) == [35, 0]
    assert _run(tmp_path) == [35, 1]
    (tmp_path / "called.py").write_text(_CALLED.replace(old, new))
    assert _run(tmp_path) == [result, 0]
    assert _run(tmp_path) == [result, 1]
