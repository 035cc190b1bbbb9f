"""Links and packets: every kind of link on loopback, streams in pieces, signatures, telemetry logs."""

import contextlib
import os
import selectors
import socket
import sys
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gcs_plugin.links import outgoing, transports
from gcs_plugin.links.mavlink import dialect
from gcs_plugin.links.packets import Framer, checksum
from gcs_plugin.links.signing import Signing, find_key, key_from, signing_time
from gcs_plugin.links.tlog_writer import TlogWriter
from gcs_plugin.links.transports import LinkAddress, SerialLink, TcpLink, UdpLink, parse_address, parse_link
from orthoswarm.model.errors import InputError
from tests.kit.vehicles.telemetry_log import read_tlog

KEY = bytes(range(32))
NOW = 1_760_000_000.0


def messages(count=5, version1=False):
    packer = dialect.MAVLink(None, 3, 1)
    result = []
    for number in range(count):
        message = dialect.MAVLink_global_position_int_message(number, 1, 2, 3, 4, 5, 6, 7, 8)
        result.append(message.pack(packer, force_mavlink1=version1))
        packer.seq += 1
    return result


def passed(moment):
    return lambda: time.monotonic() > moment


class Loop:
    """Two links that talk to each other, waited for with one selector."""

    def __init__(self, *links):
        self.links = links
        self.selector = selectors.DefaultSelector()
        for link in links:
            link.open(self.selector, time.monotonic())
        self.heard = {link: [] for link in links}
        self.peers = dict.fromkeys(links)

    def until(self, done, limit_s=60.0):
        end = time.monotonic() + limit_s
        while not done() and time.monotonic() < end:
            for key, events in self.selector.select(0.05):
                for peer, data in key.data.receive(key.fileobj, events, time.monotonic()):
                    self.heard[key.data].append(data)
                    self.peers[key.data] = peer
            for link in self.links:
                link.tick(time.monotonic())
        return done()

    def close(self):
        for link in self.links:
            link.close()
        self.selector.close()


@pytest.fixture
def loop():
    loops = []

    def make(*links):
        loops.append(Loop(*links))
        return loops[-1]

    yield make
    for made in loops:
        made.close()


def test_udp_answers_whoever_has_spoken(loop):
    ground = UdpLink("ground", "127.0.0.1", 0, listens=True)
    vehicles = [UdpLink(f"v{i}", "127.0.0.1", ground.port, listens=False) for i in range(2)]
    both = loop(ground, *vehicles)
    peers = []
    for number, vehicle in enumerate(vehicles):
        vehicle.send(vehicle.greet()[0], b"hello %d" % number)
        assert both.until(lambda n=number: len(both.heard[ground]) == n + 1)
        peers.append(both.peers[ground])
    ground.send(peers[1], b"to the second")
    assert both.until(lambda: both.heard[vehicles[1]])
    assert both.heard[vehicles[1]] == [b"to the second"] and not both.heard[vehicles[0]]
    assert not ground.greet()


def test_tcp_goes_both_ways_and_connects_again(loop):
    server = TcpLink("server", "127.0.0.1", 0, serves=True)
    port = server.port
    client = parse_link(f"tcp:127.0.0.1:{port}")
    both = loop(server, client)
    assert both.until(lambda: server.greet() and client.greet())
    client.send(client.greet()[0], b"up")
    assert both.until(lambda: both.heard[server])
    server.send(both.peers[server], b"down" * 50_000)  # more than a socket takes at once
    assert both.until(lambda: sum(map(len, both.heard[client])) == 200_000)
    server.close()
    assert both.until(lambda: client.problem != "")
    client._retry_at = 0.0
    again = TcpLink("again", "127.0.0.1", port, serves=True)
    again.open(both.selector, time.monotonic())
    both.links, both.heard[again] = (client, again), []
    assert both.until(lambda: again.greet() and client.problem == "")


def test_a_tcp_link_without_a_server_says_so_and_goes_on_trying(loop):
    server = TcpLink("server", "127.0.0.1", 0, serves=True)
    port = server.port
    server.close()
    client = parse_link(f"tcp:127.0.0.1:{port}")
    alone = loop(client)
    assert alone.until(lambda: "ECONNREFUSED" in client.problem)
    client.send("nobody", b"x")
    assert client.dropped == 1


# --- a TCP connection whose other side does not take what is sent ---


class Peer:
    """The other end of a TCP link: it takes little, and reads only when it is told to."""

    def __init__(self, loop, serves):
        self.server = None
        if not serves:
            self.server = socket.create_server(("127.0.0.1", 0))
            self.server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)  # what a connection has from the beginning
        port = 0 if serves else self.server.getsockname()[1]
        self.link = TcpLink("link", "127.0.0.1", port, serves=serves)
        self.loop = loop(self.link)
        self.connect()

    def connect(self):
        """A connection, and how the link names it."""
        if self.server is None:
            self.socket = socket.socket()
            self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
            self.socket.connect(("127.0.0.1", self.link.port))
        else:
            self.link._retry_at = 0.0
            self.socket = self.accepted()
        self.socket.setblocking(False)
        self.came = b""
        assert self.loop.until(self.link.greet)
        (self.name,) = self.link.greet()

    def accepted(self):
        self.server.setblocking(False)
        found = []

        def look():
            with contextlib.suppress(BlockingIOError):
                found.append(self.server.accept()[0])
            return found

        assert self.loop.until(look)
        return found[0]

    def fill(self):
        """Send until something is not acknowledged, though the system would take more."""

        def stuck():
            return self.name._waits_s() > 0.05 or not (
                outgoing._unacknowledged(self.name.socket) or self.link.send(self.name, b"." * 500)
            )

        assert self.loop.until(stuck) and outgoing._unacknowledged(self.name.socket)

    def read(self):
        """All that has come on this connection, which may be broken."""
        with contextlib.suppress(BlockingIOError, ConnectionResetError):
            while part := self.socket.recv(65536):
                self.came += part
        return self.came

    def close(self):
        self.socket.close()
        if self.server is not None:
            self.server.close()


@pytest.fixture(params=["connects", "serves"])
def peer(request, loop, monkeypatch):
    if sys.platform != "linux":
        pytest.skip("only Linux says what was acknowledged")
    monkeypatch.setattr(outgoing, "_STALLED_S", 60.0)  # in tests that are not about it, however slow the machine is
    monkeypatch.setitem(outgoing._OPTIONS, "TCP_USER_TIMEOUT", 60_000)
    made = Peer(loop, serves=request.param == "serves")
    yield made
    made.close()


def test_a_command_does_not_wait_in_the_system_and_is_not_sent_late(peer, monkeypatch):
    monkeypatch.setattr(outgoing, "_HELD_S", 0.05)
    peer.fill()
    expires = time.monotonic() + 0.2
    assert all(peer.link.send(peer.name, b"pause", expires) for _ in range(10))
    assert peer.loop.until(passed(expires))
    peer.read()
    assert peer.link.send(peer.name, b"resume", time.monotonic() + 60.0)
    assert peer.loop.until(lambda: b"resume" in peer.read())  # it goes on where it was
    assert b"pause" not in peer.came and peer.link.greet() == [peer.name]


def test_a_command_that_the_system_took_is_discarded_with_the_connection_when_it_expires(peer, monkeypatch):
    peer.fill()
    monkeypatch.setattr(outgoing, "_HELD_S", 60.0)
    expires = time.monotonic() + 0.2
    assert peer.link.send(peer.name, b"pause", expires)
    assert peer.loop.until(lambda: not peer.link.greet())
    assert time.monotonic() > expires
    assert b"pause" not in peer.read()
    assert not peer.link.send(peer.name, b"pause") and peer.link.dropped == 1


def test_a_stalled_connection_is_reset_and_a_new_one_works(peer, monkeypatch):
    monkeypatch.setattr(outgoing, "_HELD_S", 0.05)
    monkeypatch.setattr(outgoing, "_STALLED_S", 0.2)
    peer.fill()
    assert peer.link.send(peer.name, b"the last of the old ones")
    assert peer.loop.until(lambda: not peer.link.greet())
    assert peer.link.problem == ("" if peer.server is None else "the other side takes nothing")
    assert b"old" not in peer.read()
    peer.socket.close()
    peer.connect()
    assert peer.link.send(peer.name, b"the first of the new ones") and peer.link.problem == ""
    assert peer.loop.until(lambda: peer.read() == b"the first of the new ones")


def test_a_silent_side_that_takes_everything_gets_its_commands(peer, monkeypatch):
    """A bridge to a radio says nothing while no vehicle is heard."""
    monkeypatch.setattr(outgoing, "_HELD_S", 0.1)
    for number in range(3):
        begun = time.monotonic()
        assert peer.link.send(peer.name, b"rtl %d;" % number, begun + 60.0)
        assert peer.loop.until(lambda n=number: peer.read().endswith(b"rtl %d;" % n))
        assert peer.loop.until(passed(begun + 0.2))
    assert peer.link.greet() == [peer.name]


@pytest.mark.skipif(sys.platform == "win32", reason="pseudo terminals are POSIX")
def test_a_serial_line_goes_both_ways_and_comes_back_after_unplugging(loop):
    pytest.importorskip("serial")
    master, slave = os.openpty()
    link = parse_link(f"serial:{os.ttyname(slave)}:57600")
    assert isinstance(link, SerialLink)
    line = loop(link)
    import tty

    tty.setraw(slave)
    os.write(master, b"from the radio")
    assert line.until(lambda: b"".join(line.heard[link]) == b"from the radio")
    link.send(link.greet()[0], b"to the radio")
    assert os.read(master, 100) == b"to the radio"
    os.close(master)
    os.close(slave)
    os_error = line.until(lambda: link.problem != "")
    assert os_error and not link.greet()


@pytest.mark.skipif(sys.platform == "win32", reason="pseudo terminals are POSIX")
@pytest.mark.timeout(60)
def test_a_serial_line_that_takes_nothing_holds_up_nobody_and_its_commands_are_not_sent_late(loop):
    pytest.importorskip("serial")
    master, slave = os.openpty()
    link = parse_link(f"serial:{os.ttyname(slave)}:57600")
    line = loop(link)
    import tty

    tty.setraw(slave)

    def full():
        """The system's buffer is, and stays so."""
        waits = len(link._pending) or (link.send(link.greet()[0], b"." * 1000) and len(link._pending))
        return waits and not line.until(lambda: len(link._pending) < waits, 0.2)

    assert line.until(full)
    expires = time.monotonic() + 0.1
    assert link.send(link.greet()[0], b"pause", expires) and line.until(passed(expires))
    came = b""
    os.set_blocking(master, False)

    def resumed():
        nonlocal came
        with contextlib.suppress(BlockingIOError):
            came += os.read(master, 65536)
        return came.endswith(b"resume")

    assert not resumed()
    assert link.send(link.greet()[0], b"resume") and line.until(resumed)
    assert b"pause" not in came
    os.close(master)
    os.close(slave)


@pytest.mark.skipif(sys.platform == "win32", reason="pseudo terminals are POSIX")
def test_a_serial_line_opened_behind_a_thousand_files_is_opened_again_when_there_are_fewer(loop, monkeypatch):
    """select() knows descriptors up to 1,023."""
    monkeypatch.setattr(transports, "_RETRY_S", 0.1)
    pytest.importorskip("serial")
    resource = pytest.importorskip("resource")
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < 1200:
        pytest.skip("the system lets no process open so many files")
    resource.setrlimit(resource.RLIMIT_NOFILE, (max(soft, 1200), hard))
    master, slave = os.openpty()
    files = []
    try:
        while not files or files[-1] < 1023:
            files.append(os.open(os.devnull, os.O_RDONLY))
        link = parse_link(f"serial:{os.ttyname(slave)}:57600")
        line = loop(link)
        os.write(master, b"lost")
        assert line.until(lambda: link.problem != "") and not link.greet()
        while files:
            os.close(files.pop())
        assert line.until(lambda: link.greet() and link.problem == "")
        os.write(master, b"heard\n")
        assert line.until(lambda: b"heard" in b"".join(line.heard[link]))
    finally:
        for file in (*files, master, slave):
            os.close(file)
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ("udpin:127.0.0.1:0", UdpLink),
        ("udp:127.0.0.1:0", UdpLink),
        ("udp://127.0.0.1:0", UdpLink),
        ("udpout:127.0.0.1:14550", UdpLink),
        ("tcp:127.0.0.1:5760", TcpLink),
        ("UDPIN://127.0.0.1:0", UdpLink),
        ("127.0.0.1:0", UdpLink),
        ("udp://:0", UdpLink),
        ("tcpout://127.0.0.1:5760/", TcpLink),
        ("tcpin:127.0.0.1:0", TcpLink),
        ("/dev/ttyUSB0", SerialLink),
        ("/dev/ttyACM0,115200", SerialLink),
        ("serial:///dev/ttyUSB0:57600", SerialLink),
        ("serial:/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0:115200", SerialLink),
        ("serial_flowcontrol:///dev/ttyAMA0:921600", SerialLink),
        ("COM7:57600", SerialLink),
        ("serial:COM3", SerialLink),
    ],
)
def test_addresses_are_understood(text, kind):
    link = parse_link(text)
    assert isinstance(link, kind) and link.name == text
    link.close()


def test_one_address_has_one_meaning_however_it_is_written():
    assert str(parse_address("udp:0.0.0.0:14550")) == str(parse_address("udp://:14550")) == "udpin://0.0.0.0:14550"
    assert str(parse_address("tcp:127.0.0.1:5760")) == "tcpout://127.0.0.1:5760"
    by_path = parse_address("/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0:115200")
    assert (by_path.host, by_path.port) == ("/dev/serial/by-path/pci-0000:00:14.0-usb-0:2:1.0", 115200)
    assert parse_address("/dev/ttyUSB0") == LinkAddress("serial", "/dev/ttyUSB0", 57600)


@pytest.mark.parametrize(
    "text", ["", "udp", "14550", "http://x:80", "udpin:127.0.0.1:99999", "tcp:host:port", "udp:::1"]
)
def test_a_wrong_address_shows_an_example(text):
    with pytest.raises(InputError, match=r"udpin:0\.0\.0\.0:14550"):
        parse_link(text)


def test_a_taken_port_is_named():
    first = UdpLink("first", "127.0.0.1", 0, listens=True)
    with pytest.raises(InputError, match="in use"):
        parse_link(f"udpin:127.0.0.1:{first.port}")
    first.close()


# --- packets ---


@given(st.binary(max_size=300))
def test_the_checksum_is_mavlinks(data):
    from pymavlink.generator.mavcrc import x25crc_slow

    assert checksum(data) == x25crc_slow(data).crc


@given(st.data())
@settings(max_examples=60, deadline=None)
def test_packets_are_found_in_any_pieces_between_any_noise(data):
    """What is between packets is not a marker here: noise that looks like a packet may cost one, never invent one."""
    raws = messages(6) + messages(3, version1=True)
    stream, noise = b"", st.binary(max_size=8).map(lambda b: b.replace(b"\xfd", b"").replace(b"\xfe", b""))
    for raw in raws:
        stream += data.draw(noise) + raw
    framer, found = Framer(), []
    while stream:
        size = data.draw(st.integers(1, 80))
        found += framer.feed(stream[:size])
        stream = stream[size:]
    assert [packet.raw for packet in found] == raws
    assert [packet.message.time_boot_ms for packet in found] == [0, 1, 2, 3, 4, 5, 0, 1, 2]
    assert all(packet.system == 3 and packet.component == 1 for packet in found)


@given(st.binary(max_size=600))
@settings(max_examples=200, deadline=None)
def test_noise_never_raises_and_a_packet_after_it_is_found(noise):
    framer = Framer()
    framer.feed(noise)
    wanted = messages(1)[0]
    found = []
    for _ in range(12):  # a false start may swallow up to 280 bytes
        found += framer.feed(wanted)
    assert any(packet.raw == wanted for packet in found)


def test_a_changed_byte_is_no_packet():
    framer = Framer()
    raw = bytearray(messages(1)[0])
    raw[12] ^= 1
    assert not framer.feed(bytes(raw)) and framer.bad_checksums == 1
    assert framer.feed(messages(1)[0])


def test_decoding_equals_pymavlinks(real_data):
    decoder = dialect.MAVLink(None)
    kinds = set()
    for _, packet in read_tlog(real_data("sitl_logs") / "copter_cam_rtl_1x.tlog"):
        if packet.kind in kinds:
            continue
        kinds.add(packet.kind)
        expected = decoder.decode(bytearray(packet.raw))
        assert repr(packet.message.to_dict()) == repr(expected.to_dict())  # NaN included
        assert packet.message.get_srcSystem() == expected.get_srcSystem()
    assert len(kinds) > 15


def test_a_log_is_read_back_and_survives_a_torn_end(tmp_path):
    path = tmp_path / "flight.tlog"
    writer = TlogWriter(path)
    for number, raw in enumerate(messages(4)):
        writer.write(NOW + number, raw)
    writer.close()
    path.write_bytes(path.read_bytes()[:-5])
    assert [(t, packet.raw) for t, packet in read_tlog(path)] == list(zip((NOW + n for n in range(3)), messages(3)))


# --- signing ---


def signed(key=KEY, at=NOW, seq=0, link_id=0):
    packer = dialect.MAVLink(None, 3, 1)
    packer.signing.secret_key, packer.signing.sign_outgoing = key, True
    packer.signing.timestamp, packer.signing.link_id, packer.seq = signing_time(at), link_id, seq
    raw = dialect.MAVLink_heartbeat_message(2, 3, 81, 0, 3, 3).pack(packer)
    (packet,) = Framer().feed(raw)
    return packet


def test_only_genuine_and_new_packets_are_believed():
    ours = Signing(KEY)
    first = signed()
    assert ours.accept(first, NOW)
    assert not ours.accept(first, NOW)  # recorded and sent again
    assert ours.accept(signed(at=NOW + 1), NOW)
    assert ours.accept(signed(at=NOW, link_id=1), NOW)  # another stream
    assert not ours.accept(signed(key=bytes(32), at=NOW + 2), NOW)
    assert not ours.accept(signed(at=NOW - 120, link_id=2), NOW)  # a stream from two minutes ago
    (unsigned,) = Framer().feed(messages(1)[0])
    assert not ours.accept(unsigned, NOW)
    assert ours.rejected == 4


def test_timestamps_always_rise():
    ours = Signing(KEY)
    stamps = [ours.next_timestamp(NOW), ours.next_timestamp(NOW), ours.next_timestamp(NOW - 100)]
    assert stamps == sorted(set(stamps))


def test_a_key_comes_from_file_or_environment_and_is_never_shown(tmp_path):
    text = tmp_path / "key"
    text.write_text(KEY.hex() + "\n")
    assert find_key(text, {}) == KEY
    assert find_key(None, {"ORTHOSWARM_SIGNING_KEY_FILE": str(text)}) == KEY
    assert find_key(None, {"ORTHOSWARM_SIGNING_KEY": KEY.hex()}) == KEY
    assert find_key(None, {}) is None
    assert len(key_from(b"a passphrase")) == 32
    shown = repr(Signing(KEY))
    assert KEY.hex() not in shown and repr(KEY) not in shown
    with pytest.raises(InputError, match="cannot be read"):
        find_key(tmp_path / "absent", {})
    with pytest.raises(InputError, match="empty"):
        key_from(b"  \n")
