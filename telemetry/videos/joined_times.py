"""Times of packets in files whose clock starts again: recordings joined end to end, an encoder that was restarted."""

from typing import Any, Final

_RESTART_S: Final = 1.0  # a stream whose decoding times go back by more than this starts its clock again


class JoinedTimes:
    """Continues the pictures' clock where it starts again; metadata keeps the part of the file that it belongs to.

    Each stream shows by its own decoding times where a part ends: what lies side by side in a file at that place may
    belong to different parts.

    Args:
        pictures: the stream of pictures, whose first presentation is time zero.
        interval_s: usual time between two pictures, seconds.

    Attributes:
        joints_s: times at which a part begins, without the first.
    """

    def __init__(self, pictures: Any, interval_s: float) -> None:
        self._pictures = pictures
        self._start = pictures.start_time or 0
        self._base_s = float(pictures.start_time * pictures.time_base) if pictures.start_time is not None else 0.0
        self._interval_s = interval_s
        self._shifts_s = [0.0]
        self.joints_s: list[float] = []
        self._latest_s = 0.0
        self._part: dict[int, int] = {}
        self._decoded_s: dict[int, float] = {}

    @property
    def parts(self) -> int:
        """Number of parts whose pictures have begun."""
        return len(self._shifts_s)

    def place(self, packet: Any) -> tuple[int, float | None]:
        """The part of the next packet of the file and its seconds within it, None if it has no time."""
        stream = packet.stream.index
        part = self._part.get(stream, 0)
        if packet.dts is not None:
            decoded_s = float(packet.dts * packet.time_base)
            part += decoded_s < self._decoded_s.get(stream, decoded_s) - _RESTART_S
            self._decoded_s[stream] = decoded_s
        if packet.stream is not self._pictures:  # what follows the first picture of a part belongs to it, or to a later
            part = max(part, len(self.joints_s))
        self._part[stream] = part
        if packet.pts is None:
            return part, None
        if packet.stream is self._pictures:
            return part, float((packet.pts - self._start) * packet.time_base)
        return part, float(packet.pts * packet.time_base) - self._base_s

    def picture(self, part: int, seconds: float | None) -> float | None:
        """Time of a picture in the whole file; the first one of a part begins it after all before."""
        if part >= len(self._shifts_s):
            self.joints_s.append(self._latest_s + self._interval_s)
            self._shifts_s.append(self.joints_s[-1] - (seconds or 0.0))
        return self._moment(part, seconds)

    def metadata(self, part: int, seconds: float | None) -> float | None:
        """Time of metadata in the whole file, never before its part begins.

        Parts whose pictures never begin count as the last one that did.
        """
        part = min(part, len(self._shifts_s) - 1)
        moment = self._moment(part, seconds)
        return max(moment, self.joints_s[part - 1]) if part and moment is not None else moment

    def _moment(self, part: int, seconds: float | None) -> float | None:
        if seconds is None:
            return None
        self._latest_s = max(self._latest_s, seconds + self._shifts_s[part])
        return seconds + self._shifts_s[part]
