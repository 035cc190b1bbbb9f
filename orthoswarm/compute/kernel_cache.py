"""Where compiled kernels lie, and when they are compiled again: when anything changes that was compiled in.

First the package's own folder is searched, which `compile_kernels` fills and a wheel carries; then numba's (that of
NUMBA_CACHE_DIR, beside the file, or in the user's cache folder), where one goes that is compiled when it is called.

Numba knows a cached function by its own file. But a kernel that calls one of another file, or reads a constant of it,
has both compiled in, and would keep the old ones after an upgrade (one read beyond its array that way).
"""

import inspect
from collections.abc import Callable
from functools import cache, cached_property
from hashlib import blake2b
from pathlib import Path
from typing import Any, Final

import numpy as np
from numba.core import caching
from numba.core.dispatcher import Dispatcher
from numba.core.extending import _Intrinsic

Function = Callable[..., Any]

FOLDER: Final = Path(__file__).with_name("compiled")
"""Of the kernels that were compiled into the package."""
_OPTIONS: Final = str(Path(__file__).with_name("jit.py"))


class KernelCache:
    """What a dispatcher of numba asks for a kernel's machine code, and gives it to.

    Attributes:
        filling: class attribute; while it is true, kernels are saved in the package.
    """

    filling = False

    def __init__(self, function: Function) -> None:
        self._function = function
        self._packaged = _Packaged(function)

    def load_overload(self, signature: Any, target: Any) -> Any:
        """A compiled kernel, None where there is none for these types and processor."""
        found = self._packaged.load_overload(signature, target)
        return self._numbas.load_overload(signature, target) if found is None and not self.filling else found

    def save_overload(self, signature: Any, result: Any) -> None:
        """Keep a kernel that was just compiled."""
        (self._packaged if self.filling else self._numbas).save_overload(signature, result)

    def keep_inner(self) -> None:
        """Keep this kernel, which others alone call, in a folder that only the processes that compile those look in."""
        self._packaged = _Inner(self._function)

    def has(self, types: tuple[Any, ...], codegen: Any) -> bool:
        """Whether a kernel is there for these types of arguments, as `load_overload` would find it."""
        where = [self._packaged] if self.filling else [self._packaged, self._numbas]
        return any(kept._index_key(types, codegen) in kept._cache_file._load_index() for kept in where)

    def flush(self) -> None:
        """Forget what was compiled when it was called (for numba's `recompile`)."""
        self._numbas.flush()

    @property
    def cache_path(self) -> str:
        """Numba's folder."""
        return str(self._numbas.cache_path)

    def files(self) -> set[Path]:
        """The files of the package that hold this kernel as it is now."""
        index = self._packaged._cache_file
        names = set(index._load_index().values())
        return {Path(index._cache_path, name) for name in names | {index._index_name}} if names else set()

    @cached_property
    def _numbas(self) -> Any:
        """Made on first use: numba tries whether it can write, once for each kernel."""
        made = caching.FunctionCache(self._function)
        made._cache_file._source_stamp = compiled_in(self._function)
        return made


class _InPackage:
    """What numba calls a locator: where a kernel's files lie in the package, and what they were made of."""

    def __init__(self, function: Function, folder: Path) -> None:
        self._function, self._folder = function, folder

    def get_source_stamp(self) -> bytes:
        return compiled_in(self._function)

    def get_cache_path(self) -> str:
        return str(self._folder.joinpath(*self._function.__module__.split(".")[1:-1]))

    def ensure_cache_path(self) -> None:
        Path(self.get_cache_path()).mkdir(parents=True, exist_ok=True)

    def get_disambiguator(self) -> str:
        return str(self._function.__code__.co_firstlineno)


class _PackagedCode(caching.CompileResultCacheImpl):  # type: ignore[misc]
    folder = FOLDER

    def __init__(self, function: Function) -> None:
        """As numba's, but where the files lie is known."""
        self._locator = _InPackage(function, self.folder)
        name = function.__module__.rpartition(".")[2]
        self._filename_base = self.get_filename_base(f"{name}.{function.__qualname__}", "")


class _Packaged(caching.FunctionCache):  # type: ignore[misc]
    _impl_class = _PackagedCode


class _InnerCode(_PackagedCode):
    folder = FOLDER / "inner"


class _Inner(_Packaged):
    _impl_class = _InnerCode


def compiled_in(function: Function) -> bytes:
    """Digest of what machine code depends on: a function's file, numbers and functions of others, the options."""
    digest = blake2b(_content(function.__code__.co_filename) + _content(_OPTIONS), digest_size=16)
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
