"""python-can's reader of Vector's .blf, safe against damaged files.

It follows the size that each object states. In a damaged file that may be 0, and the reader then stays at this object
for ever. An object of no size is given another signature, which the reader takes for damage.
"""

import logging
import re
from collections.abc import Iterator
from typing import Any

import can

_NO_SIZE = re.compile(rb"LOBJ(?=.{4}\0{4})", re.DOTALL)
"""An object: signature, sizes of its header and version (2 bytes each), its size (4 bytes)."""


class BlfReader(can.BLFReader):  # type: ignore[misc]
    """Frames of a .blf; raises where it is damaged, and goes on behind that when it is iterated again."""

    def __init__(self, file: Any) -> None:
        # A line for each object of an unknown kind would fill the terminal; our own finding counts damaged places.
        logging.getLogger("can.io.blf").setLevel(logging.ERROR)
        super().__init__(file)

    def _parse_data(self, data: bytes) -> Iterator[can.Message]:
        yield from super()._parse_data(_NO_SIZE.sub(b"damg", data))
