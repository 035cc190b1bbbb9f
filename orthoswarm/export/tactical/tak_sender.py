"""Sending Cursor-on-Target events: UDP to an address or a group (ATAK's is 239.2.3.1:6969), TCP or TLS to a server."""

import ipaddress
import socket
import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from orthoswarm.model.errors import InputError, OrthoSwarmError

_HOPS: Final = 1
_WAIT_S: Final = 5.0


@dataclass(frozen=True, slots=True)
class TakAddress:
    """Where events go.

    Attributes:
        kind: `udp` (one datagram an event), `tcp` or `tls` (a stream of events). host, port: the receiver's.
        certificate: PEM file with the client's certificate and key, for `tls`. authority: PEM file of the server's CA.
    """

    kind: str
    host: str
    port: int
    certificate: Path | None = None
    authority: Path | None = None

    @classmethod
    def parse(cls, text: str, certificate: Path | None = None, authority: Path | None = None) -> "TakAddress":
        """From `udp://HOST:PORT`, `tcp://HOST:PORT` or `tls://HOST:PORT`.

        Raises:
            InputError: it is none of these.
        """
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
    """Sends events to one receiver; a broken connection is opened again with the next event.

    Args:
        address: the receiver.
    """

    def __init__(self, address: TakAddress) -> None:
        self._address = address
        self._socket: socket.socket | None = None

    def send(self, event: bytes) -> None:
        """Send one event.

        Raises:
            OrthoSwarmError: the receiver cannot be reached.
        """
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
