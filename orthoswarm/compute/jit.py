"""The two decorators for compiled kernels, so that all of them are cached and typed alike."""

from collections.abc import Callable
from typing import Any, Final, cast

import numba

from orthoswarm.compute import kernel_cache

Kernel = Callable[..., Any]

_OPTIONS: Final = {"cache": True, "nogil": True, "error_model": "numpy", "fastmath": {"nsz"}}


def kernel(function: Kernel) -> Kernel:
    """Compile a function on arrays with numba, cached on disk, releasing the GIL.

    The cache is next to the module (or in the user's cache folder if that is read-only), so only the first run on a
    machine compiles; see `kernel_cache` for when a kernel is compiled again. Kernels may call each other.

    Of `fastmath` only the sign of zero is given up. What depends on how much the compiler sees at once (reassociation,
    multiplications fused with additions, reciprocals) makes a kernel just compiled differ in its last digits from the
    same one loaded from the cache: the first run on a machine gave another map than the next, by 1 to 6 mm (the run of
    1,017 pictures takes 1 % more CPU without, medians of three pairs).
    Division by zero gives infinity or NaN, as in numpy: a test for it would keep loops from being vectorised.
    """
    kernel_cache.watch(function)
    return cast(Kernel, numba.njit(**_OPTIONS)(function))


def in_place_kernel(function: Kernel) -> Kernel:
    """A `kernel` that only works on the arrays that it is given: it makes none (numba refuses that) and returns none.

    The users of its arrays are not counted, so that a small function costs nothing when it is called for each pixel:
    numba counts them with locked instructions at every call and slice, which took a tenth of the CPU time of a run
    of 1,017 pictures (perf, samples in NRT_incref and NRT_decref).
    """
    kernel_cache.watch(function)
    return cast(Kernel, numba.njit(**_OPTIONS, _nrt=False)(function))
