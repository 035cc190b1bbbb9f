"""The one decorator for compiled kernels, so that all of them are cached and typed alike."""

from collections.abc import Callable
from typing import Any, cast

import numba

Kernel = Callable[..., Any]


def kernel(function: Kernel) -> Kernel:
    """Compile a function on arrays with numba, cached on disk, releasing the GIL.

    The cache is next to the module (or in the user's cache folder if that is read-only), so only the first run on a
    machine compiles. Kernels may call each other; after an edit of a callee touch its callers too.

    `fastmath` excludes reassociation: with it a kernel just compiled and the same one from the cache differ in their
    last digits, so that the first run on a machine gives another map than the next (measured: no slower without).
    Division by zero gives infinity or NaN, as in numpy: a test for it would keep loops from being vectorised.
    """
    compiled = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "arcp", "nsz"})
    return cast(Kernel, compiled(function))
