"""Cursor-on-Target events (MITRE, "Cursor-on-Target Message Router User's Guide", schema 2.0) for TAK programs.

A file for ATAK, WinTAK and iTAK is a data package: a ZIP with a manifest and one event a file. Live events go by UDP to
an address or a group (ATAK's is 239.2.3.1:6969), or by TCP or TLS to a server.
"""

import ipaddress
import socket
import ssl
import time
import uuid
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from orthoswarm.export.atomic_file import atomic_write
from orthoswarm.export.tactical.places import Place, utc_text
from orthoswarm.export.xml_elements import element, xml_bytes
from orthoswarm.model.errors import InputError, OrthoSwarmError

_TYPES: Final = {"vehicle": "a-f-A-M-H-Q", "find": "b-m-p-s-m"}  # friendly unmanned rotary wing; spot map marker
_UNKNOWN: Final = "9999999.0"
_STALE_S: Final = {"vehicle": 30.0, "find": 7 * 86_400.0}
_MAGENTA: Final = "-65281"  # ARGB of a find's marker as a signed 32-bit integer
_HOPS: Final = 1
_WAIT_S: Final = 5.0


def event(place: Place, now_s: float | None = None) -> bytes:
    """A place as one event, UTF-8 XML.

    Args:
        place: what it is about. now_s: when it is sent, UTC epoch seconds; the present unless said. The event is
            stale 30 s (vehicles) or seven days (finds) later.
    """
    now = time.time() if now_s is None else now_s
    start = place.time_s if place.kind == "vehicle" else now
    detail = [element("contact", callsign=place.name)]
    if place.course_deg is not None or place.speed_m_s is not None:
        course, speed = (place.course_deg or 0.0) % 360.0, place.speed_m_s or 0.0
        detail.append(element("track", course=f"{course:.1f}", speed=f"{speed:.2f}"))
    if place.kind == "find":
        detail += [element("color", argb=_MAGENTA), element("archive")]
    remarks = [place.note, *([f"pictures: {', '.join(place.pictures)}"] if place.pictures else [])]
    detail.append(element("remarks", "\n".join(text for text in remarks if text)))
    point = element(
        "point", lat=f"{place.lat_deg:.7f}", lon=f"{place.lon_deg:.7f}",
        hae=_UNKNOWN if place.height_m is None else f"{place.height_m:.1f}",
        ce=_UNKNOWN if place.sigma_m is None else f"{place.sigma_m:.2f}", le=_UNKNOWN,
    )  # fmt: skip
    return xml_bytes(
        element(
            "event", point, element("detail", *detail), version="2.0", uid=place.uid, type=_TYPES[place.kind],
            how="m-g" if place.kind == "vehicle" else "h-e", time=utc_text(now), start=utc_text(start),
            stale=utc_text(now + _STALE_S[place.kind]),
        )
    )  # fmt: skip


def write_data_package(places: Iterable[Place], path: Path, name: str = "OrthoSwarm") -> None:
    """Write places as a data package that TAK programs import.

    Args:
        places: finds and vehicles. path: the ZIP. name: what the program lists it as.

    Raises:
        OrthoSwarmError: the disk is full.
    """
    now = time.time()
    with atomic_write(path) as part, zipfile.ZipFile(part, "w", zipfile.ZIP_DEFLATED) as archive:
        contents = []
        for place in places:
            inside = f"{uuid.uuid5(uuid.NAMESPACE_URL, place.uid)}.cot"
            archive.writestr(inside, event(place, now))
            about = element("Parameter", name="uid", value=place.uid)
            contents.append(element("Content", about, ignore="false", zipEntry=inside))
        uid = str(uuid.uuid5(uuid.NAMESPACE_URL, f"orthoswarm/{name}"))
        settings = [element("Parameter", name=key, value=value) for key, value in (("uid", uid), ("name", name))]
        parts = element("Configuration", *settings), element("Contents", *contents)
        archive.writestr("MANIFEST/manifest.xml", xml_bytes(element("MissionPackageManifest", *parts, version="2")))


@dataclass(frozen=True, slots=True)
class TakAddress:
    """Where events go."""

    kind: str  # `udp` (one datagram an event), `tcp` or `tls` (a stream of events)
    host: str  # the receiver's
    port: int  # the receiver's
    certificate: Path | None = None  # PEM file with the client's certificate and key, for `tls`
    authority: Path | None = None  # PEM file of the server's CA

    @classmethod
    def parse(cls, text: str, certificate: Path | None = None, authority: Path | None = None) -> "TakAddress":
        """From `udp://HOST:PORT`, `tcp://HOST:PORT` or `tls://HOST:PORT`. Raises InputError: it is none of these."""
        try:
            parts = urlsplit(text)
            host, port = parts.hostname, parts.port
        except ValueError:
            host = port = None
        if host is None or port is None or parts.scheme not in ("udp", "tcp", "tls"):
            raise InputError(
                f"{text} is not a TAK address; give for example udp://239.2.3.1:6969 or tls://tak.local:8089"
            )
        return cls(parts.scheme, host, port, certificate, authority)


class TakSender:
    """Sends events to one receiver; a broken connection is opened again with the next event. address: the receiver."""

    def __init__(self, address: TakAddress) -> None:
        self._address = address
        self._socket: socket.socket | None = None

    def send(self, event: bytes) -> None:
        """Send one event. Raises OrthoSwarmError: the receiver cannot be reached."""
        to = self._address
        try:
            if self._socket is None:
                self._socket = self._open()
            if to.kind == "udp":
                self._socket.sendto(event, (to.host, to.port))
            else:
                self._socket.sendall(event + b"\n")
        except (OSError, ValueError) as error:  # ssl.SSLError is an OSError
            self.close()
            raise OrthoSwarmError(f"{to.kind}://{to.host}:{to.port} does not take events ({error}); check it") from None

    def close(self) -> None:
        """Close the connection."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _open(self) -> socket.socket:
        to = self._address
        if to.kind == "udp":
            link = socket.socket(socket.AF_INET6 if ":" in to.host else socket.AF_INET, socket.SOCK_DGRAM)
            if _is_group(to.host) and ":" not in to.host:
                link.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, _HOPS)
            return link
        plain = socket.create_connection((to.host, to.port), timeout=_WAIT_S)
        if to.kind == "tcp":
            return plain
        context = ssl.create_default_context(cafile=None if to.authority is None else str(to.authority))
        if to.certificate is not None:
            context.load_cert_chain(to.certificate)
        try:
            return context.wrap_socket(plain, server_hostname=to.host)
        except BaseException:
            plain.close()
            raise


def _is_group(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_multicast
    except ValueError:
        return False
