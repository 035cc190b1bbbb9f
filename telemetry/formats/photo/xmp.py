"""XMP of drone cameras: properties by name, written as attributes or as elements.

Only flat properties are needed, so the packet is searched, not parsed: a damaged packet still gives what it contains.
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

_STRUCTURES = (
    b"drone-skydio:CameraOrientationNED", b"drone-skydio:CalibratedFocalLength",
    b"drone-skydio:CalibratedOpticalCenter",
)  # fmt: skip
_MAX_STRUCTURE = 1024

_DEGREES = re.compile(
    r"\s*([+-]?)(\d{1,3}(?:\.\d*)?)(?:,(\d{1,2}(?:\.\d*)?)(?:,(\d{1,2}(?:\.\d*)?))?)?\s*([NSEWnsew]?)\s*"
)
PACKET_START = b"<x:xmpmeta"
MAX_PACKET = 1 << 18


def properties(packet: bytes) -> dict[str, str]:
    """All flat properties of a packet, "prefix:Name" -> text; of a list its first item. Never raises."""
    packet = packet[: 2 * MAX_PACKET]  # of the picture, and of a file beside it
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
    for name in _STRUCTURES:
        for field, value in _structure(packet, name).items():
            found[f"{name.decode()}/{field}"] = value
    return found


def _structure(packet: bytes, name: bytes) -> dict[str, str]:
    """Fields of a property with several, "Name" -> text: as attributes of its element or as elements within it."""
    start = packet.find(b"<" + name)
    if start < 0:
        return {}
    body = packet[start + 1 + len(name) : start + _MAX_STRUCTURE]
    end = body.find(b"</" + name)
    single = body.find(b"/>")
    if single >= 0 and (end < 0 or b"<" not in body[:single]):
        end = single
    fields = [(name, first or second) for name, first, second in _ATTRIBUTE.findall(body[: max(end, 0)])]
    fields += _ELEMENT.findall(body[: max(end, 0) + 1] + b"</")
    return {
        name.partition(b":")[2].decode("ascii", "replace"): value.decode("utf-8", "replace").strip()
        for name, value in fields
    }


def number(found: Properties, *names: str) -> float | None:
    """The first of several properties that is a finite number ("+12.30", "1/2" and "12,5" are accepted)."""
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


def degrees(found: Properties, name: str) -> float | None:
    """An angle as XMP writes it ("44,3.36N", "44,3,21.6N") or as a decimal number; None if it is no angle."""
    match = _DEGREES.fullmatch(found.get(name, ""))
    if match is None:
        return None
    value = float(match[2]) + float(match[3] or 0.0) / 60.0 + float(match[4] or 0.0) / 3600.0
    return -value if match[1] == "-" or (match[5] or "").upper() in ("S", "W") else value
