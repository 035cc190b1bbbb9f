"""How fast pictures are asked for, so that a link's other messages are not held up.

The rate follows the delay, as in LEDBAT (RFC 6817): answers that take longer than the quickest lately have waited
behind others, so the rate falls; it rises slowly otherwise, up to a bound. So pictures use only what a link has to
spare.
"""

from collections import deque
from typing import Final

_LEAST_BYTES_S: Final = 600.0
"""Two packets a second."""
_TARGET_S: Final = 0.1
_MEMORY_S: Final = 30.0
_UP, _DOWN, _LOST = 1.04, 0.75, 0.9


class LinkShare:
    """A rate that follows the delay.

    Args:
        most_bytes_s: upper bound, bytes a second.

    Attributes:
        rate: bytes a second.
    """

    def __init__(self, most_bytes_s: float) -> None:
        self.most, self.rate = most_bytes_s, min(most_bytes_s, 3.0 * _LEAST_BYTES_S)
        self._times: deque[tuple[float, float]] = deque()
        self._room, self._at = 0.0, 0.0
        self._fell_at = 0.0

    def allows(self, size: int, now: float) -> bool:
        """Whether a packet of so many bytes may be asked for now; it counts as asked for if so."""
        burst = max(float(size), 0.1 * self.rate)
        self._room = min(burst, self._room + self.rate * max(0.0, now - self._at))
        self._at = now
        if self._room < size:
            return False
        self._room -= size
        return True

    @property
    def quickest_s(self) -> float:
        """The shortest answer of the last half minute, seconds; a second while none is known."""
        return min((took for _, took in self._times), default=1.0)

    def answered(self, took_s: float, now: float) -> None:
        """An answer has come after so many seconds."""
        while self._times and self._times[0][0] < now - _MEMORY_S:
            self._times.popleft()
        self._times.append((now, took_s))
        if took_s > self.quickest_s + _TARGET_S:
            self._fall(_DOWN, now)
        else:
            self.rate = min(self.most, self.rate * _UP)

    def lost(self, now: float) -> None:
        """An answer has not come."""
        self._fall(_LOST, now)

    def _fall(self, share: float, now: float) -> None:
        if now - self._fell_at >= self.quickest_s + _TARGET_S:  # once for each round of answers
            self._fell_at = now
            self.rate = max(min(_LEAST_BYTES_S, self.most), self.rate * share)
