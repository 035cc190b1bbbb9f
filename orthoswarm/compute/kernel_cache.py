"""Where compiled kernels are cached, and when they are compiled again: when anything changes that was compiled in.

Numba knows a cached function by its own file. But a kernel that calls one of another file, or reads a constant of it,
has both compiled in, and would keep the old ones after an upgrade (one read beyond its array that way).
"""

import inspect
from collections.abc import Callable
from functools import cache
from hashlib import blake2b
from pathlib import Path
from typing import Any, Final

import numba
import numpy as np
from numba.core import caching
from numba.core.dispatcher import Dispatcher
from numba.core.extending import _Intrinsic

Function = Callable[..., Any]

_DEFAULTS: Final = (
    "UserProvidedCacheLocator", "InTreeCacheLocator", "UserWideCacheLocator", "IPythonCacheLocator", "ZipCacheLocator",
)  # fmt: skip
_known: set[Function] = set()


def watch(function: Function) -> None:
    """Cache a function, before it is compiled, by all that is compiled into it; others are cached as numba does."""
    _known.add(function)
    if not numba.config.CACHE_LOCATOR_CLASSES:
        own = (f"{__name__}.{kind.__name__}" for kind in (_Provided, _InTree, _UserWide))
        numba.config.CACHE_LOCATOR_CLASSES = ",".join([*own, *_DEFAULTS])


def compiled_in(function: Function) -> bytes:
    """Digest of what a function's machine code depends on: its file, numbers it may read, functions of other files."""
    digest = blake2b(_content(function.__code__.co_filename), digest_size=16)
    for name, value in sorted(function.__globals__.items()):
        if isinstance(value, Dispatcher | _Intrinsic):
            called = inspect.unwrap(value)
            if called.__module__ != function.__module__:
                digest.update(name.encode() + _of_another_file(called))
        elif not name.startswith("__") and _is_number(value):
            digest.update(f"{name}={value!r}".encode())
    return digest.digest()


@cache
def _of_another_file(function: Function) -> bytes:
    """`compiled_in` of a function of another file, computed once: a file that is imported from is loaded completely."""
    return compiled_in(function)


@cache
def _content(path: str) -> bytes:
    return blake2b(Path(path).read_bytes(), digest_size=16).digest()


def _is_number(value: object) -> bool:
    parts = value if isinstance(value, tuple) else (value,)
    return all(isinstance(part, bool | int | float | complex | np.generic) for part in parts)


class _Stamp:
    """What the locators below have in common: where numba's are replaced, and only for the functions that are known."""

    def __init__(self, function: Function, file: str) -> None:
        super().__init__(function, file)  # type: ignore[call-arg]
        self._function = function

    @classmethod
    def from_function(cls, function: Function, file: str) -> Any:
        return super().from_function(function, file) if function in _known else None  # type: ignore[misc]

    def get_source_stamp(self) -> bytes:
        return compiled_in(self._function)


class _Provided(_Stamp, caching.UserProvidedCacheLocator):  # type: ignore[misc]
    """In NUMBA_CACHE_DIR."""


class _InTree(_Stamp, caching.InTreeCacheLocator):  # type: ignore[misc]
    """Beside the file."""


class _UserWide(_Stamp, caching.UserWideCacheLocator):  # type: ignore[misc]
    """In the user's cache folder."""
