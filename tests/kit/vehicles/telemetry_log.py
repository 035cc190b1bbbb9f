"""Reads a telemetry log (.tlog) as `TlogWriter` writes it."""

import struct

from gcs_plugin.links.packets import Framer, packet_bytes


def read_tlog(path):
    """Time of arrival (UTC epoch seconds) and packet, one after the other; broken stretches are skipped."""
    data, at = path.read_bytes(), 0
    while at + 16 <= len(data):
        size = packet_bytes(data, at + 8)
        found = Framer().feed(data[at + 8 : at + 8 + size])
        if found:
            yield struct.unpack_from(">Q", data, at)[0] / 1e6, found[0]
        at += 8 + size if found else 1
