"""Pictures that have not arrived are read from simulated vehicles over MAVLink FTP, on links in memory."""

import numpy as np
import pytest

from gcs_plugin.daemon.flight_coverage.picture_requests import PictureNames, PictureRequests, WantedPicture
from gcs_plugin.links.file_transfer import FtpPayload, Nak, Opcode, file_crc32
from gcs_plugin.links.mavlink import Autopilot
from gcs_plugin.sim.simulated_swarm import NO_FAULTS, Faults
from orthoswarm.model.errors import DiskFullError, InputError
from tests.kit.vehicles.file_server import CardVehicle, FileServer
from tests.kit.vehicles.memory_link import World

START_S = 1_780_000_000.0


def content(number: int, size: int = 20_000) -> bytes:
    return np.random.default_rng(number).integers(0, 256, size, np.uint8).tobytes()


class Workspace:
    """What has arrived of a ground's pictures."""

    def __init__(self, ground, names):
        self.ground, self.known = ground, names

    def wanted(self):
        return list(self.ground.wanted.values())

    def names(self, vehicle):
        return self.known

    def store(self, wanted, name, data):
        if self.ground.refusal is not None:
            raise self.ground.refusal
        self.ground.stored[name] = data
        self.ground.wanted.pop(wanted.number, None)

    def changed(self):
        pass


class Ground:
    """A world with one vehicle that has files, and the requests for its pictures."""

    def __init__(self, files=None, *, wanted=(3,), names=None, up=NO_FAULTS, down=NO_FAULTS, most=30_000.0, px4=True):
        kind = Autopilot.PX4 if px4 else Autopilot.ARDUPILOT
        self.server = None if files is None else FileServer(files=dict(files))
        self.vehicle = CardVehicle(self.server, system=1, autopilot=kind)
        self.world = World([self.vehicle], up, down)
        self.wanted = {number: WantedPicture("v1", number, START_S + number) for number in wanted}
        self.stored: dict[str, bytes] = {}
        self.refusal: Exception | None = None
        self.requests = PictureRequests(
            self.world.fleet, Workspace(self, names or PictureNames()), most_bytes_s=most, clock=self.world.clock,
        )  # fmt: skip
        self.world.meet()

    def until(self, done, limit_s: float = 120.0) -> bool:
        """Advance time, as the daemon's thread does."""
        end = self.world.clock.now + limit_s
        while not done() and self.world.clock.now < end:
            self.requests.work()
            self.requests.step()
            self.world.until(lambda: False, 0.04)
        return done()

    def state(self, number: int = 3) -> tuple[str, str]:
        row = next((r for r in self.requests.rows() if r["number"] == number), {"state": "", "reason": ""})
        return row["state"], row["reason"]


@pytest.fixture
def fly():
    """Makes grounds, and closes them."""
    made: list[Ground] = []

    def make(*args, **options) -> Ground:
        made.append(Ground(*args, **options))
        return made[-1]

    yield make
    for ground in made:
        ground.world.fleet.close()


def dcim(*numbers: int, size: int = 20_000) -> dict[str, bytes]:
    return {f"/DCIM/100MEDIA/IMG_{n:04d}.JPG": content(n, size) for n in numbers}


def test_pictures_are_read_and_stored_by_their_numbers(fly) -> None:
    ground = fly(dcim(*range(1, 40)), wanted=(3, 17))
    assert ground.until(lambda: len(ground.stored) == 2)
    assert ground.stored == {"IMG_0003.JPG": content(3), "IMG_0017.JPG": content(17)}
    assert ground.until(lambda: ground.state()[0] == ground.state(17)[0] == "arrived", 5.0)
    assert {row["percent"] for row in ground.requests.rows()} == {100}


@pytest.mark.parametrize("loss", [0.1, 0.3])
def test_packets_may_be_lost_repeated_and_late(fly, loss: float) -> None:
    bad = Faults(loss=loss, duplicate=0.1, delay_s=(0.02, 0.3), seed=5)
    ground = fly(dcim(3), up=bad, down=bad)
    assert ground.until(lambda: bool(ground.stored), 600.0)
    assert ground.stored["IMG_0003.JPG"] == content(3)


def test_what_has_come_stays_while_the_link_is_silent(fly) -> None:
    silent = Faults(silent=((25.0, 110.0),))
    ground = fly(dcim(3, size=120_000), up=silent, down=silent, most=4_000.0)
    assert ground.until(lambda: ground.world.clock.now > 24.0)
    before = ground.server.served
    assert before > 20_000 and ground.state()[0] == "asked"
    assert ground.until(lambda: ground.world.clock.now > 80.0)
    assert ground.state()[0] == "waiting" and ground.requests.rows()[0]["percent"] > 10
    assert ground.until(lambda: bool(ground.stored), 300.0)
    assert ground.stored["IMG_0003.JPG"] == content(3, 120_000)
    assert ground.server.served < 1.05 * 120_000


def test_a_restarted_vehicle_is_asked_for_the_rest(fly) -> None:
    ground = fly(dcim(3, size=60_000), most=6_000.0)
    assert ground.until(lambda: ground.server.served > 20_000)
    ground.vehicle.reboot(ground.world.clock.now)
    assert ground.until(lambda: bool(ground.stored), 300.0)
    assert ground.stored["IMG_0003.JPG"] == content(3, 60_000)
    assert ground.server.served < 1.1 * 60_000


def test_a_session_of_another_station_is_waited_for(fly) -> None:
    ground = fly(dcim(3, 4))
    ground.server.answer(FtpPayload(number=900, opcode=Opcode.OPEN_FILE_RO, data=b"/DCIM/100MEDIA/IMG_0004.JPG"))
    assert ground.until(lambda: bool(ground.stored), 120.0)
    assert ground.stored["IMG_0003.JPG"] == content(3)


def test_commands_and_missions_go_first(fly) -> None:
    """On a radio of 6 kB/s a command takes no longer while pictures are read, and nothing is read meanwhile."""
    slow = Faults(bytes_s=6_000.0, delay_s=(0.05, 0.08))
    took = {}
    for files in (None, dcim(3, size=200_000)):
        ground = fly(files, up=slow, down=slow)
        if files is not None:
            assert ground.until(lambda: ground.server.served > 3_000, 60.0)  # noqa: B023
        times = []
        for _ in range(10):
            ground.until(lambda: False, 2.0)
            served, began = 0 if files is None else ground.server.served, ground.world.clock.now
            order = ground.world.fleet.download(1)
            assert ground.until(lambda: order.outcome is not None, 20.0)  # noqa: B023
            times.append(ground.world.clock.now - began)
            if files is not None:  # what was under way may still arrive: four packets
                assert ground.server.served - served <= 4 * 239
        took[files is None] = float(np.median(times))
    assert took[False] < took[True] + 0.15


def test_pictures_leave_the_rest_of_the_link_to_others(fly) -> None:
    """Telemetry comes as often as without them, over a radio that both could fill."""
    rates = {}
    for files in (None, dcim(3, size=400_000)):
        slow = Faults(bytes_s=8_000.0, delay_s=(0.05, 0.08), seed=2)
        ground = fly(files, down=slow, up=slow, px4=False)
        ground.until(lambda: False, 20.0)
        heard = []
        ground.world.fleet.subscribe(lambda *_: heard.append(1), "GLOBAL_POSITION_INT")  # noqa: B023
        ground.until(lambda: False, 60.0)
        rates[files is None] = len(heard)
        if files is not None:
            assert ground.server.served > 30_000 and ground.world.link.down.lost == 0
    assert rates[False] >= 0.95 * rates[True]


def test_the_rate_stays_below_its_bound(fly) -> None:
    ground = fly(dcim(3, size=100_000), most=2_000.0)
    assert ground.until(lambda: ground.server.served > 0)
    ground.until(lambda: False, 30.0)
    assert 20_000 < ground.server.served < 30.0 * 2_000.0


def test_what_a_vehicle_does_not_have_is_refused_with_the_reason_and_looked_for_again(fly) -> None:
    ground = fly(dcim(1, 2))
    assert ground.until(lambda: ground.state()[0] == "refused")
    assert "no picture file with number 3" in ground.state()[1]
    ground.server.files |= dcim(3)
    assert ground.until(lambda: bool(ground.stored), 120.0)


def test_a_vehicle_without_files_says_so(fly) -> None:
    ground = fly(None)
    assert ground.until(lambda: ground.state()[0] == "refused")
    assert "does not answer over MAVLink FTP" in ground.state()[1]


def test_a_folder_that_is_missing_is_named(fly) -> None:
    ground = fly({"/log/1.bin": b"x"})
    assert ground.until(lambda: ground.state()[0] == "refused")
    assert "no folder /DCIM" in ground.state()[1]


def test_a_picture_that_came_another_way_is_not_read(fly) -> None:
    ground = fly(dcim(1, 2))
    assert ground.until(lambda: ground.state()[0] == "refused")
    ground.wanted.clear()
    assert ground.until(lambda: not ground.requests.rows(), 10.0)


def test_a_full_disk_is_tried_again_and_a_file_that_is_no_picture_is_refused(fly) -> None:
    ground = fly(dcim(3))
    ground.refusal = DiskFullError("the disk is full")
    assert ground.until(lambda: ground.state() == ("waiting", "the disk is full"))
    ground.refusal = InputError("the file cannot be taken: no picture")
    assert ground.until(lambda: ground.state()[0] == "refused", 200.0)


def test_a_wrong_checksum_is_read_again_once(fly) -> None:
    ground = fly(dcim(3))
    right, calls = ground.server.answer, []

    def answer(request):
        if request.opcode == Opcode.CALC_FILE_CRC32:
            calls.append(request.number)
            return FtpPayload(number=request.number + 1, opcode=Opcode.ACK, request=request.opcode, data=b"\1\2\3\4")
        return right(request)

    ground.vehicle.files = type("Server", (), {"answer": staticmethod(answer)})()
    assert ground.until(lambda: ground.state()[0] == "refused")
    assert "checksum" in ground.state()[1] and len(calls) == 2 and not ground.stored


def test_a_server_without_checksums_is_read_all_the_same(fly) -> None:
    ground = fly(dcim(3))
    ground.server.has_crc = False
    assert ground.until(lambda: bool(ground.stored))


def test_the_checksum_is_that_of_the_protocol() -> None:
    """CRC-32 from 0 without inversion, worked out bit by bit as ArduPilot's crc_crc32 does."""
    crc = 0
    for byte in b"123456789":
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xEDB88320 if crc & 1 else 0)
    assert file_crc32(b"123456789") == crc


def test_answers_that_make_no_sense_are_ignored() -> None:
    assert FtpPayload.unpack(b"") is None
    assert FtpPayload.unpack(bytes([0, 0, 0, 128, 255, 5, 0, 0, 0, 0, 0, 0]).ljust(251, b"x")) is None
    packed = FtpPayload(number=7, opcode=Opcode.NAK, request=5, data=bytes([Nak.END_OF_FILE])).pack()
    assert len(packed) == 251 and FtpPayload.unpack(packed).nak == Nak.END_OF_FILE


FILES = {f"/DCIM/100/DJI_{n:04d}.JPG": 1 for n in range(40, 60)}


@pytest.mark.parametrize(
    ("names", "number", "files", "expected"),
    [
        (PictureNames(), 45, FILES, "/DCIM/100/DJI_0045.JPG"),
        (PictureNames({"DJI_0041.JPG"}, 40), 5, FILES, "/DCIM/100/DJI_0045.JPG"),
        (PictureNames(), 45, FILES | {"/DCIM/101/DJI_0045.JPG": 1}, "several of its files have number 45"),
        (PictureNames({"DJI_0041.JPG"}, 0), 45, FILES | {"/DCIM/101/DJI_0045.JPG": 1}, "/DCIM/100/DJI_0045.JPG"),
        (PictureNames({"DJI_0001.JPG"}, 0), 45, FILES, "/DCIM/100/DJI_0045.JPG"),
        (PictureNames({"v1-0041.jpg"}, 0), 45, FILES, "its files have other names than the pictures that have arrived"),
        (PictureNames(set(), None), 45, FILES, "the numbers of its files do not match those of its camera events"),
        (PictureNames(), 45, {"/DCIM/DJI_0045.txt": 1}, "it has no picture file with number 45"),
    ],
)
def test_a_file_is_found_by_its_number_or_not_at_all(names, number, files, expected) -> None:
    path, reason = names.find(number, files)
    assert (path or reason) == expected and not (path and reason)


def test_the_shift_between_files_and_events_is_that_of_the_pictures_that_arrived() -> None:
    events = [(n, START_S + 2.0 * n) for n in range(20)]
    arrived = [(f"DJI_{n + 411:04d}.JPG", START_S + 2.0 * n + 0.3) for n in range(0, 20, 3)]
    assert PictureNames.of(arrived, events).shift == 411
    assert PictureNames.of(arrived[:2], events).shift == 0
    mixed = [(f"IMG_{(37 * k) % 91}.JPG", START_S + 2.0 * k) for k in range(10)]
    assert PictureNames.of(mixed, events).shift is None
