"""MAVLink 2 message signing: the key, signing of outgoing packets, checking of incoming ones.

A packet carries a link id, a time in units of 10 microseconds since 2015 and the first six bytes of SHA-256 over key
and packet (https://mavlink.io/en/guide/message_signing.html). The key comes from a file or the environment and is never
shown: not in messages, logs, process lists or `repr`.
"""

import hashlib
import hmac
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from gcs_plugin.links.mavlink import Message, dialect
from gcs_plugin.links.packets import Packet
from orthoswarm.model.errors import InputError

KEY_VARIABLE: Final = "ORTHOSWARM_SIGNING_KEY"
KEY_FILE_VARIABLE: Final = "ORTHOSWARM_SIGNING_KEY_FILE"

_EPOCH_2015_S: Final = 1_420_070_400
_MINUTE: Final = 60 * 100_000
_UNSIGNED_ALLOWED: Final = frozenset({int(dialect.MAVLINK_MSG_ID_RADIO_STATUS)})


def signing_time(utc_s: float) -> int:
    """UTC epoch seconds as a signing timestamp (10 microseconds since 1 January 2015)."""
    return int((utc_s - _EPOCH_2015_S) * 100_000)


@dataclass(slots=True)
class Signing:
    """Signs outgoing packets of a link and checks incoming ones.

    Attributes:
        key: 32 bytes.
        link_id: distinguishes the streams of one sender.
        rejected: packets dropped because their signature is missing, wrong or old.
    """

    key: bytes = field(repr=False)
    link_id: int = 0
    rejected: int = 0
    _time: int = 0
    _streams: dict[tuple[int, int, int], int] = field(default_factory=dict, repr=False)

    def __post_init__(self) -> None:
        """Check the key."""
        if len(self.key) != 32:
            raise InputError("a signing key has 32 bytes; give 64 hex digits or a passphrase")

    def accept(self, packet: Packet, utc_s: float) -> bool:
        """True if a packet is genuine and new; unsigned ones are not, but for the radio's own status."""
        good = self._genuine(packet, utc_s) if packet.signed else packet.kind in _UNSIGNED_ALLOWED
        self.rejected += not good
        return good

    def next_timestamp(self, utc_s: float) -> int:
        """The timestamp for the next outgoing packet: now, and always later than the one before."""
        self._time = max(self._time + 1, signing_time(utc_s))
        return self._time

    def _genuine(self, packet: Packet, utc_s: float) -> bool:
        raw = packet.raw
        if not hmac.compare_digest(hashlib.sha256(self.key + raw[:-6]).digest()[:6], raw[-6:]):
            return False
        stamp = int.from_bytes(raw[-12:-6], "little")
        stream = (raw[-13], packet.system, packet.component)
        last = self._streams.get(stream)
        if stamp <= last if last is not None else stamp + _MINUTE < max(self._time, signing_time(utc_s)):
            return False
        self._streams[stream] = stamp
        self._time = max(self._time, stamp)
        return True


class Packer:
    """Makes packets of messages: counts them and, with `signing`, signs them."""

    def __init__(self, system: int, component: int, signing: Signing | None = None) -> None:
        self._mav, self._signing = dialect.MAVLink(None, system, component), signing
        if signing is not None:
            self._mav.signing.secret_key, self._mav.signing.sign_outgoing = signing.key, True
            self._mav.signing.link_id = signing.link_id

    def pack(self, message: Message, utc_s: float) -> bytes:
        """The next packet, sent at a time in UTC epoch seconds."""
        if self._signing is not None:
            self._mav.signing.timestamp = self._signing.next_timestamp(utc_s)
        raw = bytes(message.pack(self._mav))
        self._mav.seq = (self._mav.seq + 1) & 0xFF
        return raw


def key_from(text: bytes) -> bytes:
    """The 32 bytes of a key: as they are, as 64 hex digits, or the SHA-256 of a passphrase, as other stations do it."""
    if len(text) == 32:
        return text
    stripped = text.strip()
    if re.fullmatch(rb"[0-9a-fA-F]{64}", stripped):
        return bytes.fromhex(stripped.decode())
    if not stripped:
        raise InputError("the signing key is empty; give 64 hex digits or a passphrase")
    return hashlib.sha256(stripped).digest()


def find_key(path: Path | None = None, environment: Mapping[str, str] = os.environ) -> bytes | None:
    """The signing key from a file, else from the environment; None where nothing is set.

    A named file counts before ORTHOSWARM_SIGNING_KEY_FILE, that before ORTHOSWARM_SIGNING_KEY.

    Raises:
        InputError: the file cannot be read, or the key is empty.
    """
    named = path or (Path(environment[KEY_FILE_VARIABLE]) if environment.get(KEY_FILE_VARIABLE) else None)
    if named is not None:
        try:
            return key_from(named.read_bytes())
        except OSError as error:
            raise InputError(
                f"the signing key file {named} cannot be read ({error.strerror}); check its name"
            ) from None
    text = environment.get(KEY_VARIABLE)
    return key_from(text.encode()) if text else None
