"""How independent tasks are run: the seam between what is computed and the processes that compute it."""

from collections.abc import Callable, Iterable, Sequence
from typing import Any, Protocol, TypeVar

T = TypeVar("T")


class Run(Protocol):
    """Runs tasks one after the other, in processes or on a cluster; results come in the order of the items."""

    def __call__(self, function: Callable[[Any], T], items: Sequence[Any], /) -> Iterable[T]:
        """Yield function(item) for each item."""


def serial(function: Callable[[Any], T], items: Sequence[Any], /) -> Iterable[T]:
    """Run tasks one after the other in this process."""
    return map(function, items)
