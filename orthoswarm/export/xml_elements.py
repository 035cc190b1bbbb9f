"""XML as nested elements, with which KML, GPX and Cursor-on-Target are written."""

import re
from typing import Final
from xml.etree.ElementTree import Element, tostring

_ILLEGAL: Final = re.compile("[^\t\n\r\x20-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")


def element(tag: str, *content: Element | str, **attributes: str) -> Element:
    """An element with its attributes, and its text or its children, without characters that XML 1.0 cannot hold."""
    made = Element(tag, {key: _ILLEGAL.sub("", value) for key, value in attributes.items()})
    for each in content:
        if isinstance(each, str):
            made.text = _ILLEGAL.sub("", each)
        else:
            made.append(each)
    return made


def texts(**by_tag: str | None) -> list[Element]:
    """An element for each text that is there."""
    return [element(tag, text) for tag, text in by_tag.items() if text]


def xml_bytes(root: Element) -> bytes:
    """A document in UTF-8."""
    return bytes(tostring(root, encoding="utf-8", xml_declaration=True))


def kml_bytes(*content: Element) -> bytes:
    """A document of KML 2.2 (OGC 12-007r2)."""
    return xml_bytes(element("kml", element("Document", *content), xmlns="http://www.opengis.net/kml/2.2"))
