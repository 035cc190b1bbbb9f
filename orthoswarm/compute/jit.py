"""The two decorators for compiled kernels, so that all of them are cached and typed alike."""

from collections.abc import Callable
from typing import Any, Final, cast

import numba
from numba.core.types import misc
from numba.core.typing.templates import builtin_registry
from numba.np import arrayobj

from orthoswarm.compute import processor
from orthoswarm.compute.kernel_cache import KernelCache

processor.choose()

Kernel = Callable[..., Any]

_OPTIONS: Final = {"no_cfunc_wrapper": True, "nogil": True, "error_model": "numpy", "fastmath": {"nsz"}}


def kernel(function: Kernel) -> Kernel:
    """Compile a function on arrays with numba, cached on disk, releasing the GIL.

    They are compiled beforehand, see `compile_kernels`, and again when anything changes that is compiled
    in, see `kernel_cache`. Kernels may call each other. The code is for a baseline processor, see `processor`.

    Of `fastmath` only the sign of zero is given up. What depends on how much the compiler sees at once (reassociation,
    multiplications fused with additions, reciprocals) makes a kernel just compiled differ in its last digits from the
    same one loaded from the cache: the first run on a machine gave another map than the next, by 1 to 6 mm (the run of
    1,017 pictures takes 1 % more CPU without, medians of three pairs).
    Division by zero gives infinity or NaN, as in numpy: a test for it would keep loops from being vectorised.
    """
    return _compiled(function)


def in_place_kernel(function: Kernel) -> Kernel:
    """A `kernel` that only works on the arrays that it is given: it makes none (numba refuses that) and returns none.

    The users of its arrays are not counted, so that a small function costs nothing when it is called for each pixel:
    numba counts them with locked instructions at every call and slice, which took a tenth of the CPU time of a run
    of 1,017 pictures (perf, samples in NRT_incref and NRT_decref).
    """
    return _compiled(function, _nrt=False)


def _fit(_source: Any, _target: Any) -> Kernel:
    def refuse(_source: Any, _target: Any) -> None:
        raise ValueError("the shapes of an assignment differ")

    return refuse


def _spare_shapes_in_messages() -> None:
    """Have `a[...] = b` of other shapes fail with a fixed text: numba's tells both, by string functions.

    To compile those took a sixth of the time of all kernels.
    """
    for function, kind in builtin_registry.globals:
        if function is getattr(arrayobj, "raise_with_shape_context", None):
            for template in kind.templates:
                template._overload_func = staticmethod(_fit)


_spare_shapes_in_messages()


def _compiled(function: Kernel, **options: bool) -> Kernel:
    made = numba.njit(**_OPTIONS, **options)(function)
    made._cache = KernelCache(function)
    called = made.get_call_template

    def without_constants(args: Any, keywords: Any) -> Any:
        """Types of a call in another kernel, so that one with a constant needs no code of its own."""
        return called(tuple(map(misc.unliteral, args)), {name: misc.unliteral(kind) for name, kind in keywords.items()})

    made.get_call_template = without_constants
    return cast(Kernel, made)
