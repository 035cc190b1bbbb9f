"""In which order, and which way round, to fly legs: local search on the length of the ways between them."""

from typing import Final

import numpy as np

from orthoswarm.compute.jit import in_place_kernel, kernel
from orthoswarm.model.arrays import Array
from orthoswarm.planning.lines.detours import Router

_ORDERED_MOST_LEGS: Final = 500  # orders of more legs are not improved: cost grows with the square (for its time)


@kernel
def _improve(between, order, fixed, rounds):  # type: ignore[no-untyped-def]
    """2-opt and or-opt on a row of directed legs, in place; end 2k is the start of leg k, 2k + 1 its end.

    order[i] = 2 * leg + flipped. between[a, b] is the way from end a to end b, symmetric. Where `fixed` >= 0, the row
    begins and ends at that extra end (a depot).
    """
    n = len(order)
    for _ in range(rounds):
        better = False
        for i in range(n):
            for j in range(i, n):  # reverse order[i..j], each leg turned round
                head, tail = _entry(order[i]), _exit(order[j])
                old = new = 0.0
                if i > 0 or fixed >= 0:
                    before = _exit(order[i - 1]) if i > 0 else fixed
                    old += between[before, head]
                    new += between[before, tail]
                if j < n - 1 or fixed >= 0:
                    after = _entry(order[j + 1]) if j < n - 1 else fixed
                    old += between[tail, after]
                    new += between[head, after]
                if new < old - 1e-6:
                    a, b = i, j
                    while a < b:
                        order[a], order[b] = order[b] ^ 1, order[a] ^ 1
                        a += 1
                        b -= 1
                    if a == b:
                        order[a] = order[a] ^ 1
                    better = True
        for size in range(1, 4):  # move up to three neighbours elsewhere, either way round
            for i in range(n - size + 1):
                if _move(between, order, fixed, i, size):
                    better = True
        if not better:
            break


@in_place_kernel
def _entry(code):  # type: ignore[no-untyped-def]
    return 2 * (code >> 1) + (code & 1)


@in_place_kernel
def _exit(code):  # type: ignore[no-untyped-def]
    return 2 * (code >> 1) + 1 - (code & 1)


@in_place_kernel
def _way(between, order, k, fixed, to):  # type: ignore[no-untyped-def]
    """Way from the end of order[k] (or the depot) to an end (or the depot): 0 where the row just ends."""
    a = _exit(order[k]) if k >= 0 else fixed
    return between[a, to] if a >= 0 and to >= 0 else 0.0


@kernel
def _move(between, order, fixed, i, size):  # type: ignore[no-untyped-def]
    """Move order[i : i + size] to the best other place if that shortens the row."""
    n = len(order)
    rest = np.empty(n - size, order.dtype)
    rest[:i] = order[:i]
    rest[i:] = order[i + size :]
    block = order[i : i + size].copy()
    head, tail = _entry(block[0]), _exit(block[size - 1])
    after = _entry(rest[i]) if i < n - size else fixed
    gain = _way(between, order, i - 1, fixed, head) - _way(between, order, i - 1, fixed, after)
    gain += between[tail, after] if after >= 0 else 0.0
    best, place, flip = 1e-6, -1, False
    for k in range(n - size + 1):
        if k == i:
            continue
        after = _entry(rest[k]) if k < n - size else fixed
        base = _way(between, rest, k - 1, fixed, after)
        for turned in range(2):
            a, b = (head, tail) if turned == 0 else (tail, head)
            cost = _way(between, rest, k - 1, fixed, a) + (between[b, after] if after >= 0 else 0.0) - base
            if gain - cost > best:
                best, place, flip = gain - cost, k, turned == 1
    if place < 0:
        return False
    order[:place] = rest[:place]
    order[place + size :] = rest[place:]
    for k in range(size):
        order[place + k] = block[size - 1 - k] ^ 1 if flip else block[k]
    return True


def shorten(legs: Array, router: Router, depot: Array | None = None) -> Array:
    """The same legs in an order, and each in a direction, with shorter ways between them.

    Args:
        legs: float64 (n, 2, 2) in flying order; a good order to begin with. router: measures ways around obstacles.
        depot: float64 (2,) where the row begins and ends; None leaves both ends open.

    Returns:
        float64 (n, 2, 2). Rows of more than `_ORDERED_MOST_LEGS` legs come back as they are.
    """
    n = len(legs)
    if n < 2 or n > _ORDERED_MOST_LEGS:
        return legs
    ends = legs.reshape(-1, 2)
    if depot is not None:
        ends = np.concatenate([ends, np.asarray(depot, np.float64).reshape(1, 2)])
    between = np.minimum(router.distances(ends, ends), 1e9)
    order = 2 * np.arange(n)
    _improve(np.ascontiguousarray(between), order, 2 * n if depot is not None else -1, 60)
    return np.array([legs[c >> 1][::-1] if c & 1 else legs[c >> 1] for c in order])
