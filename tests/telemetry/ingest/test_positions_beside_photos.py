"""Positions in files beside photos: GPX and NMEA tracks, XMP; what is not read is named."""

from datetime import UTC, datetime

import numpy as np
import pytest

from telemetry import load
from telemetry.formats.log.flight_logs import read_log
from telemetry.formats.log.log_data import NotALog
from telemetry.formats.log.receiver_track import read_track
from telemetry.formats.photo import xmp
from telemetry.ingest.ingest import survey
from tests.telemetry.ingest.test_photos import gps_exif, jpeg

START_S = 1_777_888_800.0
METRE = 1.0 / 111_194.93
TAKEN_S = [0.0, 3.0, 6.0, 10.0, 14.0, 18.0, 22.0, 25.0]


def photos(folder, **tags):
    """Photos without positions."""
    folder.mkdir(exist_ok=True)
    for k, t in enumerate(TAKEN_S):
        moment = datetime.fromtimestamp(START_S + t, UTC)
        exif = gps_exif(0.0, 0.0, local=f"{moment:%Y:%m:%d %H:%M:%S}", subsec="0", offset="+00:00")
        jpeg(folder / f"P_{k}.JPG", exif_bytes=exif, **tags)
    return folder


def north(t):
    return 44.0 + 8.0 * t * METRE


def gpx(times, *, prefix="", dated=True, end="</trkseg></trk></gpx>"):
    points = []
    for t in times:
        said = (
            f"<{prefix}time>{datetime.fromtimestamp(START_S + t, UTC):%Y-%m-%dT%H:%M:%SZ}</{prefix}time>"
            if dated
            else ""
        )
        points.append(
            f"<{prefix}trkpt lon='-123.07' lat='{north(t):.8f}'><{prefix}ele>250</{prefix}ele>{said}</{prefix}trkpt>"
        )
    return f"<?xml version='1.0'?><{prefix}gpx><trk><trkseg>{''.join(points)}{end}"


def checksum(body):
    return f"${body}*{int(np.bitwise_xor.reduce(np.frombuffer(body.encode(), np.uint8))):02X}"


def rmc(t, *, valid="A"):
    moment = datetime.fromtimestamp(START_S + t, UTC)
    minutes = 60.0 * (north(t) - 44.0)
    return checksum(f"GNRMC,{moment:%H%M%S}.00,{valid},44{minutes:09.6f},N,12304.2,W,5.0,0.0,{moment:%d%m%y},,,A")


def gga(t, quality=1):
    moment = datetime.fromtimestamp(START_S + t, UTC)
    minutes = 60.0 * (north(t) - 44.0)
    return checksum(f"GPGGA,{moment:%H%M%S}.00,44{minutes:09.6f},N,12304.2,W,{quality},12,0.8,250.5,M,30.0,M,,")


def check(folder):
    frames = load([folder]).frames
    assert len(frames) == len(TAKEN_S)
    for frame, t in zip(frames, TAKEN_S):
        assert frame.fix.lat_deg == pytest.approx(north(t), abs=0.3 * METRE)
        assert frame.fix.lon_deg == pytest.approx(-123.07, abs=1e-6)
    return frames


@pytest.mark.parametrize("prefix", ["", "gpx:"])
def test_photos_beside_a_gpx_track_lie_on_it(tmp_path, prefix):
    folder = photos(tmp_path / "card")
    (folder / "Track.GPX").write_text(gpx(range(-6, 36, 3), prefix=prefix))
    assert "track of Track.GPX" in check(folder)[0].origin["position"]


def test_a_track_that_was_not_closed_gives_what_it_holds_and_one_without_times_says_so(tmp_path):
    (tmp_path / "a.gpx").write_text(gpx(range(0, 30, 3), end="<trkpt lat='44.1' lon="))
    assert len(read_track(tmp_path / "a.gpx").samples) == 10
    (tmp_path / "b.gpx").write_text(gpx(range(0, 30, 3), dated=False))
    with pytest.raises(NotALog, match="have no times"):
        read_track(tmp_path / "b.gpx")


def test_a_pause_of_a_track_is_not_bridged(tmp_path):
    folder = photos(tmp_path / "card")
    (folder / "a.gpx").write_text(gpx([*range(-6, 8, 2), *range(20, 36, 2)]))
    found = load([folder])
    assert len(found.frames) == 5 and {r.image for r in found.rejected} == {"P_3.JPG", "P_4.JPG", "P_5.JPG"}


@pytest.mark.parametrize("name", ["a.nmea", "a.log"])
def test_photos_beside_nmea_sentences_lie_on_them(tmp_path, name):
    folder = photos(tmp_path / "card")
    lines = [line for t in range(0, 36, 2) for line in (rmc(t), gga(t))]
    lines += [rmc(60, valid="V"), gga(61, quality=0), rmc(62).replace("N,123", "S,123")]
    (folder / name).write_text("noise\r\n" + "\r\n".join(lines))
    frames = check(folder)
    assert frames[0].fix.altitude_m == pytest.approx(250.5)
    assert len(read_log(folder / name)[0].samples) == 18


def test_sentences_are_dated_over_midnight_and_none_before_a_date_is_known(tmp_path):
    body = "GPGGA,{},4400.0,N,12304.2,W,1,12,0.8,250.5,M,30.0,M,,"
    lines = [checksum(body.format("235957.00")), checksum("GPZDA,235958.00,31,12,2025,00,00")]
    lines += [checksum(body.format(clock)) for clock in ("235959.00", "000001.50")]
    (tmp_path / "a.nmea").write_text("\n".join(lines))
    log = read_track(tmp_path / "a.nmea")
    assert [s.time_s for s in log.samples] == [1_767_225_599.0, 1_767_225_601.5]
    assert any(f.code == "track-without-time" for f in log.findings)


def test_checksums_that_are_all_wrong_are_not_heeded_and_single_ones_are(tmp_path):
    lines = [rmc(t) for t in range(10)]
    (tmp_path / "a.nmea").write_text("\n".join([*lines[:9], lines[9][:-2] + "ZZ".replace("Z", "0")]))
    assert len(read_track(tmp_path / "a.nmea").samples) == 9
    (tmp_path / "b.nmea").write_text("\n".join(line[:-2] + "00" for line in lines))
    log = read_track(tmp_path / "b.nmea")
    assert len(log.samples) == 10 and [f.code for f in log.findings] == ["checksum-wrong"]


PACKET = '<x:xmpmeta><rdf:Description exif:GPSLatitude="{}" exif:GPSLongitude="{}"/></x:xmpmeta>'


@pytest.mark.parametrize("named", ["P_{}.xmp", "P_{}.JPG.XMP"])
def test_xmp_beside_photos_is_read(tmp_path, named):
    folder = photos(tmp_path / "card")
    for k, t in enumerate(TAKEN_S):
        packet = PACKET.format(f"44,{60.0 * (north(t) - 44.0):.8f}N", "123,4.2W")
        (folder / named.format(k)).write_text(packet)
    assert check(folder)[0].origin["position"] == "XMP position"


def test_xmp_within_photos_is_read(tmp_path):
    folder = photos(tmp_path / "card", xmp_packet=PACKET.format("44,3,21.6N", "123,4,12W").encode())
    frames = load([folder / "P_0.JPG"]).frames
    assert frames[0].fix.lat_deg == pytest.approx(44.056) and frames[0].fix.lon_deg == pytest.approx(-123.07)


@pytest.mark.parametrize("text,expected", [("44,3.36N", 44.056), ("123,4,12W", -123.07), ("-44.5", -44.5), ("x", None)])
def test_angles_of_xmp(text, expected):
    assert xmp.degrees({"a": text}, "a") == (None if expected is None else pytest.approx(expected))


def test_files_that_may_hold_positions_are_named_and_loudly_where_they_are_missed(tmp_path):
    folder = photos(tmp_path / "card")
    for name in ("a.fit", "b.fit", "c.kml", "other.xmp", "readme.md"):
        (folder / name).write_text("x")
    (warning,) = [w for w in load([folder]).warnings if "not read" in w]
    assert "a.fit and 1 more .fit, c.kml, other.xmp" in warning and "readme" not in warning
    (folder / "a.gpx").write_text(gpx(range(-6, 36, 3)))
    (finding,) = [f for f in survey([folder]).findings if f.code == "side-file-unread"]
    assert finding.note
