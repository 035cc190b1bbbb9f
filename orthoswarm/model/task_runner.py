"""How independent tasks are run: the seam between what is computed and the processes that compute it."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar

T = TypeVar("T")
Progress = Callable[[str, int, int], None]  # told what is being done, how many of it are done, and how many there are


@dataclass(frozen=True, slots=True)
class Continued(Generic[T]):
    """The first half of a task returns this; the second half, `function(item)`, may run in another process.

    Its result is the task's. Few long tasks leave processes idle at the end (two processes take as long for three
    flights as for four); with halved tasks they are idle for half as long.
    """

    function: "Callable[[Any], T | Continued[T]]"
    item: Any


class Run(Protocol):
    """Runs tasks one after the other, in processes or on a cluster; results come in the order of the items."""

    def __call__(self, function: Callable[[Any], T | Continued[T]], items: Sequence[Any], /) -> Iterable[T]:
        """Yield function(item) for each item, or what it is continued by."""


def serial(function: Callable[[Any], T | Continued[T]], items: Sequence[Any], /) -> Iterable[T]:
    """Run tasks one after the other in this process."""
    return (whole(function, item) for item in items)


def whole(function: Callable[[Any], T | Continued[T]], item: Any) -> T:
    """The result of a task, its continuation included, in this process."""
    value = function(item)
    while isinstance(value, Continued):
        value = value.function(value.item)
    return value
