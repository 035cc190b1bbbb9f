"""TLS of `serve --lan`, looked at as a scanner does: protocols, ciphers, certificate, names, and who is let in."""

import contextlib
import hashlib
import ipaddress
import re
import socket
import ssl
import subprocess
import sys
import time
import warnings
from datetime import UTC, datetime, timedelta
from urllib.parse import urlsplit

import pytest
from cryptography import x509
from cryptography.hazmat.primitives.asymmetric import ec

from gcs_plugin.mavproxy.daemon_client import Client
from gcs_plugin.web import certificate
from gcs_plugin.web.certificate import CERTIFICATE, KEY, client_context, fingerprint, server_context, spoken
from orthoswarm.model.errors import InputError
from tests.kit.daemon_kit import serving

LAN = ("--lan", "--bind", "127.0.0.1")


@pytest.fixture(scope="module")
def workspace(tmp_path_factory):
    return tmp_path_factory.mktemp("post")


@pytest.fixture(scope="module")
def served(workspace):
    with serving(workspace, *LAN) as served:
        yield served


def shake(served, *, least=ssl.TLSVersion.MINIMUM_SUPPORTED, most=ssl.TLSVersion.MAXIMUM_SUPPORTED, ciphers=None):
    """Protocol and cipher of a handshake with a client that can do only this; the error if there is none."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    context.set_ciphers(f"{ciphers or 'ALL'}:@SECLEVEL=0")  # or this client would refuse first
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of what the server has to refuse
        context.minimum_version, context.maximum_version = least, most
    with socket.create_connection(("127.0.0.1", urlsplit(served.url).port), timeout=60) as plain:
        try:
            with context.wrap_socket(plain, server_hostname="localhost") as secured:
                return secured.version(), secured.cipher()
        except (ssl.SSLError, ConnectionError) as error:
            return error


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1, ssl.TLSVersion.TLSv1_1])
def test_old_protocols_are_refused(served, version):
    assert isinstance(shake(served, least=version, most=version), Exception)


@pytest.mark.parametrize("version", [ssl.TLSVersion.TLSv1_2, ssl.TLSVersion.TLSv1_3])
def test_present_protocols_have_forward_secrecy_and_authenticated_ciphers(served, version):
    named, (cipher, _, bits) = shake(served, least=version, most=version)
    assert named == {"TLSv1_2": "TLSv1.2", "TLSv1_3": "TLSv1.3"}[version.name]
    assert bits >= 128 and ("GCM" in cipher or "CHACHA20" in cipher)
    assert cipher.startswith(("ECDHE-ECDSA", "TLS_"))


@pytest.mark.parametrize(
    "ciphers", ["AES128-SHA", "ECDHE-ECDSA-AES128-SHA", "AES256-GCM-SHA384", "NULL", "DHE-RSA-AES256-GCM-SHA384"]
)
def test_weak_ciphers_are_refused(served, ciphers):
    assert isinstance(shake(served, most=ssl.TLSVersion.TLSv1_2, ciphers=ciphers), Exception)


def test_the_certificate_names_this_machine_and_is_its_own(served, workspace):
    context = ssl.create_default_context(cafile=workspace / CERTIFICATE)
    context.verify_flags |= ssl.VERIFY_X509_PARTIAL_CHAIN
    port = urlsplit(served.url).port
    for name in ("localhost", "127.0.0.1"):  # its name is checked as browsers do
        with (
            socket.create_connection(("127.0.0.1", port)) as plain,
            context.wrap_socket(plain, server_hostname=name) as s,
        ):
            der = s.getpeercert(binary_form=True)
            assert s.selected_alpn_protocol() is None and s.compression() is None
    with socket.create_connection(("127.0.0.1", port)) as plain, pytest.raises(ssl.SSLCertVerificationError):
        context.wrap_socket(plain, server_hostname="evil.example")
    with socket.create_connection(("127.0.0.1", port)) as plain, pytest.raises(ssl.SSLCertVerificationError):
        ssl.create_default_context().wrap_socket(plain, server_hostname="localhost")  # no authority has signed it
    told = "".join(served.said)
    assert fingerprint(workspace / KEY) in told
    assert fingerprint(workspace / KEY).replace(" ", "").lower() == hashlib.sha256(der).hexdigest()
    assert spoken(fingerprint(workspace / KEY)) in told
    read = x509.load_der_x509_certificate(der)
    key = read.public_key()
    assert isinstance(key, ec.EllipticCurvePublicKey) and key.curve.name == "secp256r1"
    names = read.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert ipaddress.ip_address("127.0.0.1") in names.get_values_for_type(x509.IPAddress)
    assert not read.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    now = datetime.now(UTC)
    assert now + timedelta(days=365) < read.not_valid_after_utc < now + timedelta(days=826)


def test_its_key_can_be_read_by_its_owner_alone(served, workspace):
    assert (workspace / KEY).stat().st_mode & 0o777 == 0o600
    assert b"PRIVATE" not in (workspace / CERTIFICATE).read_bytes()


def test_plain_http_gets_no_answer(served):
    with socket.create_connection(("127.0.0.1", urlsplit(served.url).port), timeout=60) as plain:
        plain.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        with contextlib.suppress(ConnectionError):
            assert b"HTTP/" not in plain.recv(4096)


def test_every_answer_forbids_frames_and_foreign_scripts(served):
    headers = served.get("/").headers
    assert headers["x-frame-options"] == "DENY" and "default-src 'self'" in headers["content-security-policy"]


def test_nothing_but_the_page_is_open(served):
    assert served.url.startswith("https://")
    assert served.get("/").status_code == 200 and served.get("/healthz").status_code == 200
    for path in ("/api/vehicles", "/tiles/best/1/0/0.png", "/metrics", "/docs", "/openapi.json"):
        assert served.get(path).status_code == 401
        assert served.get(path, headers=served.auth).status_code == 200


def test_programs_of_this_machine_trust_the_workspaces_certificate(served, workspace):
    assert Client(served.url, served.token, workspace).ask("/api/vehicles") == []
    with pytest.raises(RuntimeError, match="does not answer"):
        Client(served.url, served.token).ask("/api/vehicles")


def test_an_invitation_is_printed_from_another_terminal(served, workspace):
    command = [sys.executable, "-m", "gcs_plugin.cli", "serve", "--workspace", str(workspace), "--invite"]
    made = subprocess.run([*command, "Eva M=analyst"], capture_output=True, text=True, timeout=240)
    assert re.fullmatch(rf"analyst Eva M: {re.escape(served.url)}/#invitation=\S+\n", made.stdout), made.stderr
    wrong = subprocess.run([*command, "Eva=chief"], capture_output=True, text=True, timeout=240)
    assert wrong.returncode == 1 and "choose viewer, analyst, pilot" in wrong.stderr


@pytest.mark.slow
def test_connections_that_do_not_speak_are_closed(served):
    port = urlsplit(served.url).port
    with contextlib.ExitStack() as open_ones:
        idle = [open_ones.enter_context(socket.create_connection(("127.0.0.1", port), timeout=120)) for _ in range(50)]
        assert served.get("/healthz").status_code == 200
        assert all(one.recv(1) == b"" for one in idle)


# -- the files --------------------------------------------------------------------------------------------------------


def test_a_certificate_stays_and_is_renewed_before_it_expires(tmp_path, monkeypatch):
    names = {"localhost", "127.0.0.1"}
    path = certificate.take_certificate(tmp_path, names)
    first = fingerprint(path)
    assert fingerprint(certificate.take_certificate(tmp_path, names)) == first
    assert fingerprint(tmp_path / CERTIFICATE) == first
    moved = fingerprint(certificate.take_certificate(tmp_path, names | {"10.0.0.7"}))
    assert moved != first
    assert fingerprint(certificate.take_certificate(tmp_path, names)) == moved  # back in the first network
    monkeypatch.setattr(certificate, "_RENEWED", timedelta(days=900))
    assert fingerprint(certificate.take_certificate(tmp_path, names)) != moved


def test_a_given_certificate_is_used(tmp_path):
    own = certificate.take_certificate(tmp_path, {"post.example", "127.0.0.1"})
    with serving(tmp_path / "w", *LAN, "--certificate", str(own), "--key", str(own)) as served:
        client_context(tmp_path / CERTIFICATE)
        assert Client(served.url, served.token, tmp_path / CERTIFICATE).ask("/api/vehicles") == []
        assert fingerprint(own) in "".join(served.said) and not (tmp_path / "w" / KEY).exists()


def test_files_that_do_not_belong_together_are_told(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    one, other = (certificate.take_certificate(tmp_path / name, {"localhost"}) for name in "ab")
    with pytest.raises(InputError, match="belong together"):
        server_context(tmp_path / "a" / CERTIFICATE, other)
    assert isinstance(server_context(one, one), ssl.SSLContext)
    one.write_text("nothing")
    with pytest.raises(InputError, match="remove it"):
        certificate.take_certificate(tmp_path / "a", {"localhost"})
    with pytest.raises(InputError, match="cannot be used"):
        server_context(one, tmp_path / "nowhere.pem")


@pytest.mark.parametrize(
    ("flags", "told"),
    [
        (["--certificate", "x.pem", "--lan"], "needs its key"),
        (["--open-reading"], "give --lan"),
        (["--certificate", "x.pem", "--key", "y.pem"], "give --lan"),
    ],
)
def test_flags_that_do_not_go_together_are_told(tmp_path, flags, told):
    command = [sys.executable, "-m", "gcs_plugin.cli", "serve", "--workspace", str(tmp_path), *flags]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=240)
    assert ended.returncode == 2 and told in ended.stderr


def test_serving_others_in_clear_is_warned_of(tmp_path):
    with serving(tmp_path, "--bind", "0.0.0.0") as served:
        end = time.monotonic() + 60
        while "use --lan instead" not in "".join(served.said):
            assert time.monotonic() < end
            time.sleep(0.05)
        assert served.get("/api/vehicles").status_code == 401


def test_the_words_are_the_digits_that_a_browser_shows():
    assert spoken("3F A9 00 1B 22 22 22 22 FF") == "three foxtrot alfa nine, zero zero one bravo, " + ", ".join(
        ["two two two two"] * 2
    )
