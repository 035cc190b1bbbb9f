"""TLS for `serve --lan`: a certificate of the daemon's own, made at its first start, and what people compare of it.

No authority signs it, as there is no internet: a browser warns once, and whoever opens the page compares the
fingerprint that the browser shows with the one that the operator reads out, in the words of radio operators.
"""

import contextlib
import hashlib
import ipaddress
import os
import socket
import ssl
from collections.abc import Collection
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Final

from gcs_plugin.web.guard import write_secret
from orthoswarm.export.atomic_file import write_file
from orthoswarm.model.errors import InputError

CERTIFICATE: Final = "certificate.pem"
KEY: Final = "certificate-and-key.pem"
_VALID: Final = timedelta(days=825)  # Apple's devices accept none that is valid for longer
_RENEWED: Final = timedelta(days=60)  # before its end: an operation ends before it does
_WORDS: Final = "zero one two three four five six seven eight nine alfa bravo charlie delta echo foxtrot"
_SAID: Final = 16  # digits that are read out: 64 bits, for which nobody makes a second certificate in time
_CIPHERS: Final = "ECDHE+AESGCM:ECDHE+CHACHA20"  # of TLS 1.2, with forward secrecy; those of 1.3 all have it
_SIOCGIFADDR: Final = 0x8915  # Linux: the address of an interface


def take_certificate(folder: Path, names: Collection[str]) -> Path:
    """The file with the daemon's own certificate and its key, which only its owner can read.

    A new one is made if there is none, if it expires soon, or if this machine has a name or address that it lacks.
    The certificate alone lies beside it (CERTIFICATE), to be handed out.

    Args:
        folder: the workspace. names: names and IP addresses of this machine.

    Raises:
        InputError: the file cannot be read. OSError: or written.
    """
    path, known = folder / KEY, set[str]()
    if path.exists():
        known, expires = _contents(path)
        if set(names) <= known and expires - datetime.now(UTC) > _RENEWED:
            return path
    certificate, key = _made(sorted({*names, *known}))
    write_secret(path, key + certificate)
    write_file(folder / CERTIFICATE, certificate)
    return path


def _contents(path: Path) -> tuple[set[str], datetime]:
    """The names and addresses of a certificate, and when it expires."""
    from cryptography import x509

    try:
        certificate = x509.load_pem_x509_certificate(path.read_bytes())
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except (OSError, ValueError, x509.ExtensionNotFound) as error:
        raise InputError(
            f"{path} has no certificate of this daemon ({error}); remove it, and another is made"
        ) from None
    texts = {str(value) for kind in (x509.DNSName, x509.IPAddress) for value in names.get_values_for_type(kind)}
    return texts, certificate.not_valid_after_utc


def _made(names: list[str]) -> tuple[bytes, bytes]:
    """A new certificate with its own key (ECDSA, P-256), both PEM."""
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes, serialization
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID

    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "OrthoSwarm")])
    alternatives: list[x509.GeneralName] = []
    for name in names:
        try:
            alternatives.append(x509.IPAddress(ipaddress.ip_address(name)))
        except ValueError:
            alternatives.append(x509.DNSName(name))
    now = datetime.now(UTC)
    certificate = (
        x509.CertificateBuilder(subject, subject, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - timedelta(days=1))  # clocks in the field are set by hand
        .not_valid_after(now + _VALID)
        .add_extension(x509.SubjectAlternativeName(alternatives), critical=False)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False)
        .sign(key, hashes.SHA256())
    )
    pem = serialization.Encoding.PEM
    plain = serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    return certificate.public_bytes(pem), key.private_bytes(pem, *plain)


def server_context(certificate: Path, key: Path) -> ssl.SSLContext:
    """TLS 1.2 and later, for a certificate (chain) and its key, PEM files; raises InputError: they cannot be used."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.set_ciphers(_CIPHERS)
    context.options |= ssl.OP_NO_RENEGOTIATION | ssl.OP_NO_COMPRESSION | ssl.OP_CIPHER_SERVER_PREFERENCE
    context.set_alpn_protocols(["http/1.1"])
    try:
        context.load_cert_chain(certificate, key, password=b"")  # a key with a password is refused, nobody is asked
    except (OSError, ValueError) as error:  # an SSLError is an OSError
        raise InputError(
            f"{certificate} with the key {key} cannot be used ({getattr(error, 'reason', None) or error});"
            " give PEM files that belong together, the key without a password"
        ) from None
    return context


def client_context(certificate: Path) -> ssl.SSLContext:
    """For a program on this machine that reads the daemon's certificate from its file and accepts no other."""
    context = ssl.create_default_context(cafile=certificate)
    context.check_hostname = False  # the file names the daemon better than its address
    context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
    return context


def fingerprint(certificate: Path) -> str:
    """SHA-256 of a certificate as browsers show it, in pairs: "3F A9 ..."; of a chain, of the first."""
    text = certificate.read_text(encoding="ascii", errors="replace")
    begin, end = "-----BEGIN CERTIFICATE-----", "-----END CERTIFICATE-----"
    first = begin + text.split(begin, 1)[1].split(end, 1)[0] + end
    return hashlib.sha256(ssl.PEM_cert_to_DER_cert(first)).digest().hex(" ").upper()


def spoken(fingerprint: str) -> str:
    """The beginning of a fingerprint in words, four digits at a time: "three foxtrot alfa nine, ..."."""
    named = _WORDS.split()
    words = [named[int(digit, 16)] for digit in fingerprint.replace(" ", "")[:_SAID]]
    return ", ".join(" ".join(words[k : k + 4]) for k in range(0, len(words), 4))


def own_addresses() -> list[str]:
    """The IPv4 addresses of this machine, without loopback, those by which others reach it first."""
    found: dict[str, None] = {}
    with contextlib.suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect(("192.0.2.1", 9))  # sends nothing: tells the way that packets would take
        found[probe.getsockname()[0]] = None
    with contextlib.suppress(ImportError, AttributeError):
        import fcntl

        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            for _, name in socket.if_nameindex():
                with contextlib.suppress(OSError):  # it has none
                    answer = fcntl.ioctl(probe, _SIOCGIFADDR, os.fsencode(name)[:15].ljust(256, b"\0"))
                    found[socket.inet_ntoa(answer[20:24])] = None
    with contextlib.suppress(OSError):
        found.update((str(row[4][0]), None) for row in socket.getaddrinfo(socket.gethostname(), None, socket.AF_INET))
    return [address for address in found if not ipaddress.ip_address(address).is_loopback]


def own_names() -> set[str]:
    """Names and addresses of this machine, for its certificate."""
    host = socket.gethostname().split(".")[0].lower()
    named = {f"{host}", f"{host}.local"} if host.replace("-", "").isalnum() and host.isascii() else set()
    return {"localhost", "127.0.0.1", "::1", *named, *own_addresses()}
