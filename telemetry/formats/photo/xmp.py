"""XMP of drone cameras: properties by their names, whether they are written as attributes or as elements.

Only flat properties are needed, so the packet is searched, not parsed: a damaged one still gives what it has.
Sources: DJI, Parrot and Pix4D ("Camera" name space; senseFly, MicaSense, Autel and Sequoia write it) manuals.
"""

import re
from collections.abc import Mapping

Properties = Mapping[str, str]

_ATTRIBUTE = re.compile(rb"""([A-Za-z][\w.-]{0,63}:[A-Za-z]\w{0,63})\s*=\s*(?:"([^"<]{0,1024})"|'([^'<]{0,1024})')""")
_ELEMENT = re.compile(rb"<([A-Za-z][\w.-]{0,63}:[A-Za-z]\w{0,63})>([^<]{1,1024})</")
_LIST = re.compile(
    rb"<([A-Za-z][\w.-]{0,63}:[A-Za-z]\w{0,63})>\s*<rdf:(?:Seq|Bag|Alt)>\s*<rdf:li[^>]{0,64}>([^<]{1,1024})</"
)

PACKET_START = b"<x:xmpmeta"
_MAX_PACKET = 1 << 18


def properties(packet: bytes) -> dict[str, str]:
    """All flat properties of a packet, "prefix:Name" -> text; of a list its first item. Never raises."""
    packet = packet[:_MAX_PACKET]
    found: dict[str, str] = {}
    for name, first, second in _ATTRIBUTE.findall(packet):
        if not name.startswith((b"xmlns:", b"rdf:", b"x:")):
            found[name.decode("ascii", "replace")] = (first or second).decode("utf-8", "replace").strip()
    for name, value in _ELEMENT.findall(packet):
        if not name.startswith(b"rdf:"):
            found[name.decode("ascii", "replace")] = value.decode("utf-8", "replace").strip()
    if b"rdf:li" in packet:
        for name, value in _LIST.findall(packet):
            found.setdefault(name.decode("ascii", "replace"), value.decode("utf-8", "replace").strip())
    return found


def number(found: Properties, *names: str) -> float | None:
    """The first of several properties that is a finite number ("+12.30", "1/2" and "12,5" are understood)."""
    for name in names:
        value = found.get(name)
        if value is None:
            continue
        top, _, bottom = value.strip().replace(",", ".").partition("/")
        try:
            result = float(top) / (float(bottom) if bottom else 1.0)
        except (ValueError, ZeroDivisionError):
            continue
        if result == result and abs(result) != float("inf"):
            return result
    return None
