"""Finds and vehicles for other programs: what arrives, and what their readers find in the files."""

import csv
import json
import socket
import ssl
import subprocess
import threading
import zipfile
from dataclasses import replace
from html.parser import HTMLParser
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from gcs_plugin.daemon.exports import TakFeed, places_of
from orthoswarm.export.tactical.cursor_on_target import TakAddress, TakSender, event, write_data_package
from orthoswarm.export.tactical.places import (
    FILE,
    Place,
    read_places,
    sightings,
    write_csv,
    write_geojson,
    write_gpx,
    write_kml,
)
from orthoswarm.model.camera import NADIR_PITCH_RAD, Camera, Lens, rotation_from_angles
from orthoswarm.model.errors import InputError, OrthoSwarmError
from orthoswarm.model.frame import Fix, Frame
from orthoswarm.model.placement import PlacedFrame

FIND = Place(uid="w-find-1", kind="find", name="Roof <down> & \x00out", lat_deg=47.3977, lon_deg=-8.5456, sigma_m=0.5,
             time_s=1_780_000_000.25, note="=2+3", pictures=("a.jpg", "b.jpg"))  # fmt: skip
DRONE = Place(uid="w-v1", kind="vehicle", name="Falcon", lat_deg=47.4, lon_deg=8.5, time_s=1_780_000_000.0,
              height_m=550.0, course_deg=271.0, speed_m_s=8.0)  # fmt: skip


def test_an_event_says_what_where_when_and_for_how_long():
    find, drone = (ElementTree.fromstring(event(place, 1_780_000_010.0)) for place in (FIND, DRONE))
    assert (drone.get("uid"), drone.get("type"), drone.get("how")) == ("w-v1", "a-f-A-M-H-Q", "m-g")
    assert drone.get("start") == "2026-05-28T20:26:40.000Z" and drone.get("stale") == "2026-05-28T20:27:20.000Z"
    assert drone.find("point").attrib == {
        "lat": "47.4000000", "lon": "8.5000000", "hae": "550.0", "ce": "9999999.0", "le": "9999999.0",
    }  # fmt: skip
    assert drone.find("detail/track").attrib == {"course": "271.0", "speed": "8.00"}
    assert find.get("type") == "b-m-p-s-m" and find.find("point").get("ce") == "0.50"
    assert find.find("detail/contact").get("callsign") == "Roof <down> & out"
    assert find.find("detail/remarks").text == "=2+3\npictures: a.jpg, b.jpg"


def test_a_data_package_names_each_event_in_its_manifest(tmp_path):
    write_data_package([FIND, DRONE], tmp_path / "places.zip", "flood")
    with zipfile.ZipFile(tmp_path / "places.zip") as archive:
        manifest = ElementTree.fromstring(archive.read("MANIFEST/manifest.xml"))
        named = {content.get("zipEntry") for content in manifest.findall("Contents/Content")}
        assert named == set(archive.namelist()) - {"MANIFEST/manifest.xml"}
        assert {ElementTree.fromstring(archive.read(name)).get("uid") for name in named} == {"w-find-1", "w-v1"}


def test_other_programs_read_the_same_places(tmp_path):
    import pyogrio

    for write, name in ((write_geojson, FILE), (write_kml, "p.kml"), (write_gpx, "p.gpx"), (write_csv, "p.csv")):
        write([FIND, DRONE], tmp_path / name)
    assert read_places(tmp_path) == [FIND, DRONE]
    for name, layer in ((FILE, None), ("p.kml", None), ("p.gpx", "waypoints")):
        box = pyogrio.read_bounds(tmp_path / name, layer=layer)[1]
        assert np.allclose(box[:2].T, [[-8.5456, 47.3977], [8.5, 47.4]]), name
    with (tmp_path / "p.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    assert rows[0]["note"] == "'=2+3"  # no formula in a spreadsheet
    assert float(rows[0]["lat_deg"]) == FIND.lat_deg and rows[1]["sigma_m"] == ""


@given(note=st.text(st.characters(), max_size=40), workspace=st.text(st.characters(), max_size=10))
def test_a_note_of_any_text_hinders_no_export(tmp_path_factory, note, workspace):
    row = {"id": 1, "lat_deg": 47.0, "lon_deg": 8.0, "sigma_m": None, "note": note, "time": "2026-05-28T20:26:40Z"}
    (place,) = places_of(workspace, [row], [], 0.0)
    folder = tmp_path_factory.mktemp("p")
    for write, name in ((write_geojson, FILE), (write_kml, "p.kml"), (write_gpx, "p.gpx"), (write_csv, "p.csv")):
        write([place], folder / name)
    assert read_places(folder) == [place]
    for name in ("p.kml", "p.gpx"):
        ElementTree.parse(folder / name)
    write_data_package([place], folder / "p.zip", "w")


class Shown(HTMLParser):
    """What a browser shows of HTML, and the tags in it."""

    def __init__(self, text):
        super().__init__()
        self.text, self.tags = "", []
        self.feed(text)
        self.close()

    def handle_data(self, data):
        self.text += data

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)


@pytest.mark.parametrize(
    "note",
    [
        "<script>alert(1)</script><img src=x onerror=alert(1)>",
        "water < 1 m & rising; &lt;b&gt; stays",
        "two\nlines",
        "$[name] $[description]",
    ],
)
def test_google_earth_shows_a_note_as_it_was_written(note, tmp_path):
    """Descriptions and balloons of KML are HTML; what a user wrote is text in it."""
    write_kml([replace(FIND, name=note, note=note, sigma_m=None, pictures=())], tmp_path / "p.kml")
    kml = {"k": "http://www.opengis.net/kml/2.2"}
    mark = ElementTree.parse(tmp_path / "p.kml").getroot().find(".//k:Placemark", kml)
    assert mark.findtext("k:name", None, kml) == note  # plain text by the standard
    lines = ["br"] * note.count("\n")
    for path, wanted, tags in (
        ("k:description", note, lines),
        (".//k:BalloonStyle/k:text", f"{note}\n{note}", ["b", *lines, "br", *lines]),
    ):
        text = mark.findtext(path, None, kml)
        assert (Shown(text).text, Shown(text).tags) == (wanted, tags) and "$[" not in text


def test_a_changed_list_of_places_is_refused(tmp_path):
    assert read_places(tmp_path) == []
    (tmp_path / FILE).write_text(json.dumps({"features": [{"geometry": None}]}))
    with pytest.raises(InputError, match="not a list of places"):
        read_places(tmp_path)


def test_the_pictures_that_show_a_place_come_best_first():
    lens = Lens(400, 300, 300.0)
    down = rotation_from_angles(0.0, NADIR_PITCH_RAD, 0.0)

    def placed(name, east, height=60.0):
        frame = Frame(
            image=name, path=None, vehicle="v1", time_s=0.0, fix=Fix(47.0, 8.0, height), width=None, height=(400, 300)
        )
        return PlacedFrame(frame, Camera(np.array([east, 0.0, height]), down, lens), "fine", 0.1)

    frames = [placed("far", 30.0), placed("near", 2.0), placed("out", 80.0), placed("below", 0.0, -5.0)]
    found = sightings(frames, (0.0, 0.0, 0.0))
    assert [s.placed.frame.image for s in found] == ["near", "far"]
    assert found[0].column == pytest.approx(200.0 - 10.0, abs=1.0) and found[0].row == pytest.approx(150.0, abs=1.0)


# -- sending ----------------------------------------------------------------------------------------------------------


def test_datagrams_go_to_an_address_and_to_a_group():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(10.0)
        sender = TakSender(TakAddress.parse(f"udp://127.0.0.1:{receiver.getsockname()[1]}"))
        sender.send(event(DRONE))
        assert ElementTree.fromstring(receiver.recv(65536)).get("uid") == "w-v1"
        sender.close()


@pytest.mark.parametrize("kind", ["tcp", "tls"])
def test_a_stream_of_events_reaches_a_server_also_after_it_was_gone(tmp_path, kind):
    wrap, authority = (lambda s: s), None
    if kind == "tls":
        pem = tmp_path / "server.pem"
        subprocess.run(
            ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "1", "-subj", "/CN=127.0.0.1",
             "-addext", "subjectAltName=IP:127.0.0.1", "-keyout", str(pem), "-out", str(tmp_path / "cert.pem")],
            check=True, capture_output=True,
        )  # fmt: skip
        authority = tmp_path / "cert.pem"
        pem.write_text(pem.read_text() + authority.read_text())
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        context.load_cert_chain(pem)
        wrap = lambda s: context.wrap_socket(s, server_side=True)  # noqa: E731
    with socket.create_server(("127.0.0.1", 0)) as server:
        server.settimeout(20.0)
        port = server.getsockname()[1]
        heard = []

        def serve():
            for _ in range(2):
                with wrap(server.accept()[0]) as link:
                    heard.append(link.recv(65536))

        thread = threading.Thread(target=serve)
        thread.start()
        for _ in range(2):  # the second one by a sender that opens anew
            sender = TakSender(TakAddress.parse(f"{kind}://127.0.0.1:{port}", authority=authority))
            sender.send(event(FIND))
            sender.close()
        thread.join(20.0)
    assert [ElementTree.fromstring(data).get("uid") for data in heard] == ["w-find-1"] * 2
    with pytest.raises(OrthoSwarmError, match=f"{kind}://127.0.0.1:{port} does not take events"):
        TakSender(TakAddress.parse(f"{kind}://127.0.0.1:{port}", authority=authority)).send(event(FIND))


@pytest.mark.parametrize("text", ["239.2.3.1:6969", "http://a:1", "udp://a", "udp://a:99999", "udp://[", ""])
def test_an_address_that_is_none_is_refused(text):
    with pytest.raises(InputError, match="not a TAK address"):
        TakAddress.parse(text)


@pytest.mark.slow
def test_the_feed_sends_vehicles_always_and_finds_when_they_are_new():
    places = [DRONE]
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(30.0)
        feed = TakFeed(
            [TakAddress.parse(f"udp://127.0.0.1:{receiver.getsockname()[1]}")], SimpleNamespace(places=lambda: places)
        )
        feed.start()
        try:
            heard = [ElementTree.fromstring(receiver.recv(65536)).get("uid") for _ in range(2)]
            places.append(FIND)
            heard += [ElementTree.fromstring(receiver.recv(65536)).get("uid") for _ in range(3)]
        finally:
            feed.close()
    assert heard[:2] == ["w-v1"] * 2 and heard.count("w-find-1") == 1 and feed.problem == ""
