"""The one decorator for compiled kernels, so that all of them are cached and typed alike."""

from collections.abc import Callable
from typing import Any, cast

import numba

Kernel = Callable[..., Any]


def kernel(function: Kernel) -> Kernel:
    """Compile a function on arrays with numba, cached on disk, releasing the GIL.

    The cache is next to the module (or in the user's cache folder if that is read-only), so only the first run on a
    machine compiles. Kernels may call each other. The cache knows a file by its content: after an edit of a callee, or
    of a constant of another file, callers in other files must change, too, or their old code is used.

    Of `fastmath` only the sign of zero is given up. What depends on how much the compiler sees at once (reassociation,
    multiplications fused with additions, reciprocals) makes a kernel just compiled differ in its last digits from the
    same one loaded from the cache: the first run on a machine gave another map than the next, by 1 to 6 mm (the run of
    1,017 pictures takes 1 % more CPU without, medians of three pairs).
    Division by zero gives infinity or NaN, as in numpy: a test for it would keep loops from being vectorised.
    """
    compiled = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"nsz"})
    return cast(Kernel, compiled(function))
