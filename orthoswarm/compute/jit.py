"""The one decorator for compiled kernels, so that all of them are cached and typed alike."""

from collections.abc import Callable
from typing import Any, cast

import numba

Kernel = Callable[..., Any]


def kernel(function: Kernel) -> Kernel:
    """Compile a function on arrays with numba, cached on disk, releasing the GIL.

    The cache lies beside the module (or in the user's cache folder where that is read-only), so only the
    first run on a machine compiles. Kernels may call each other; after an edit of a callee touch its callers too.

    Sums are not reassociated: a kernel that was just compiled and the same one from the cache would give other last
    digits, and the first run on a machine another map than the next (measured: no slower without).
    """
    return cast(Kernel, numba.njit(cache=True, nogil=True, fastmath={"contract", "arcp", "nsz"})(function))
