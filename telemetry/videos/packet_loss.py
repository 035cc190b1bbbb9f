"""Finds pictures of a video that are damaged because data from which they are predicted was lost.

A picture predicted from a damaged one is damaged, too, although the decoder reports only the first: so damage extends
in decoding order from the lost packet to the next recovery point, a complete key picture (H.264: IDR or recovery point
SEI, H.265: IRAP). Losses in files show as gaps in the continuity counters of MPEG-TS (ISO/IEC 13818-1, 2.4.3.3), as
decoding errors, and as pictures concealed by the decoder; for live streams see `LiveDamage`.
"""

from bisect import bisect_right
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_TS_PACKET, _SYNC = 188, 0x47
_CHUNK_PACKETS = 1 << 17


def transport_gaps(path: Path, pid: int) -> list[tuple[int, int]]:
    """Where packets of a stream are missing from an MPEG-TS file: offsets of the packets before and after each gap.

    Empty for files of other kinds. Raises OSError: it cannot be read.
    """
    gaps: list[tuple[int, int]] = []
    last: tuple[int, int] | None = None  # counter and offset
    with path.open("rb") as handle:
        base = 0
        while data := handle.read(_CHUNK_PACKETS * _TS_PACKET):
            rows = np.frombuffer(data[: len(data) // _TS_PACKET * _TS_PACKET], np.uint8).reshape(-1, _TS_PACKET)
            if not len(rows) or (rows[:, 0] == _SYNC).mean() < 0.99:
                return gaps
            own = np.flatnonzero(_is_payload(rows, pid))
            counters, offsets = (rows[own, 3] & 15).tolist(), (base + own * _TS_PACKET).tolist()
            for counter, offset in zip(counters, offsets, strict=True):
                if last is not None and counter != last[0] and counter != (last[0] + 1) & 15:
                    gaps.append((last[1], offset))
                last = counter, offset
            base += len(data)
    return gaps


def _is_payload(rows: NDArray[np.uint8], pid: int) -> NDArray[np.bool_]:
    """Whether a packet has a payload: only those increment the counter."""
    number = ((rows[:, 1].astype(np.int64) & 31) << 8) | rows[:, 2]
    return np.asarray((number == pid) & ((rows[:, 3] & 16) > 0))


class Damage:
    """Tracks damage through the packets of a video, by their index in decoding order.

    Attributes:
        undecoded: number of packets that could not be decoded at all.
    """

    def __init__(self) -> None:
        self.undecoded = 0
        self._recoveries: list[int] = []
        self._losses: set[int] = set()
        self._last_loss: dict[int, int] = {}

    def packet(self, index: int, *, is_key: bool, is_lost: bool) -> None:
        """Record a packet: whether it is a recovery point, whether data is missing in or before it."""
        if is_lost:
            self.lost(index)
        elif is_key:
            self._recoveries.append(index)

    def lost(self, index: int) -> None:
        """Record that a packet cannot be decoded completely."""
        if index not in self._losses:
            self._losses.add(index)
            section = self._section(index)
            self._last_loss[section] = min(index, self._last_loss.get(section, index))

    def is_damaged(self, index: int) -> bool:
        """Whether a packet's picture is, or may be predicted from, a damaged one."""
        first = self._last_loss.get(self._section(index))
        return first is not None and first <= index

    def _section(self, index: int) -> int:
        """Number of recovery points up to a packet: damage does not extend from one section into the next."""
        return bisect_right(self._recoveries, index)


class LiveDamage:
    """Tracks damage through the packets of a live stream, without a file in which to look for gaps.

    FFmpeg marks the data in which a continuity counter jumped, but its parsers put the mark on the picture that they
    complete at that moment, the one before: both count as lost (measured on H.264 and H.265 in MPEG-TS, 2 of 300
    transport packets lost: every damaged picture is found, and one undamaged picture per loss is reported as damaged).
    """

    def __init__(self) -> None:
        self._damage = Damage()
        self._count = 0
        self._was_marked = False

    def packet(self, *, is_key: bool, is_marked: bool) -> int:
        """Record the next packet; returns its index, with which its picture can be queried."""
        index = self._count
        self._damage.packet(index, is_key=is_key, is_lost=is_marked or self._was_marked)
        self._was_marked, self._count = is_marked, index + 1
        return index

    def failed(self) -> None:
        """Record that the newest packet could not be decoded."""
        self._damage.lost(max(0, self._count - 1))

    def is_damaged(self, index: int | None, is_concealed: bool) -> bool:
        """Whether a packet's picture is damaged; one concealed by the decoder damages those after it, too."""
        if index is None:
            return is_concealed
        if is_concealed:
            self._damage.lost(index)
        return self._damage.is_damaged(index)
