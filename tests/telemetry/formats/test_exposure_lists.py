"""Lists of exposures of GNSS receivers, beside photos that know only their time."""

from datetime import UTC, datetime

import numpy as np
import pytest

from telemetry.formats.log.flight_logs import NotALog, read_log
from telemetry.ingest.ingest import load, survey
from tests.telemetry.ingest.test_photos import gps_exif, jpeg

WEEK, TOW = 2264, 400_373.5
UTC_S = 315_964_800 + WEEK * 604_800 + TOW - 18
STEPS = np.cumsum([0.0, 2.1, 1.9, 2.0, 6.3, 2.2, 2.0, 1.8, 7.1, 2.0, 2.1, 1.9])


def write_mrk(path):
    rows = [
        f"{i + 1}\t{TOW + t:.6f}\t[{WEEK}]\t  -40,N\t   0,E\t  86,V\t{47.5 + t * 1e-5:.8f},Lat\t8.25000000,Lon\t"
        "359.494,Ellh\t0.011, 0.012, 0.025\t50,Q"
        for i, t in enumerate(STEPS)
    ]
    path.write_text("\n".join(rows) + "\n")


def write_pos(path):
    columns = "latitude(deg) longitude(deg)  height(m)   Q  ns   sdn(m)   sde(m)   sdu(m)"
    lines = ["% program   : RTKPOST", f"%  GPST    {columns}"]
    for t in STEPS:
        moment = datetime.fromtimestamp(UTC_S + 18 + t, UTC)
        stamp = moment.strftime("%Y/%m/%d %H:%M:%S.%f")[:-3]
        lines.append(f"{stamp}   {47.5 + t * 1e-5:.9f}    8.250000000   359.4940   1  12   0.0110   0.0120   0.0250")
    path.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize(("name", "write"), [("flight_Timestamp.MRK", write_mrk), ("flight_events.pos", write_pos)])
def test_photos_get_the_positions_of_their_exposures(tmp_path, name, write):
    write(tmp_path / name)
    (log,) = read_log(tmp_path / name)
    assert [event.time_s - UTC_S for event in log.events] == pytest.approx(STEPS, abs=2e-3)
    assert log.events[0].sample.sigma_m == 0.012
    for i, t in enumerate(STEPS):
        local = datetime.fromtimestamp(UTC_S + 7200 + t, UTC)
        stamp, fraction = local.strftime("%Y:%m:%d %H:%M:%S"), f"{local.microsecond // 10_000:02d}"
        jpeg(tmp_path / f"DJI_{i + 1:04d}.JPG", exif_bytes=gps_exif(0.0, 0.0, local=stamp, subsec=fraction))
    frames = load([tmp_path]).frames
    assert len(frames) == len(STEPS)
    for frame, t in zip(frames, STEPS, strict=True):
        assert frame.fix.lat_deg == pytest.approx(47.5 + t * 1e-5, abs=1e-8)
        assert frame.fix.position_sigma_m == 0.012
        assert name in frame.origin["position"]


def test_a_list_without_exposures_is_named(tmp_path):
    (tmp_path / "a.pos").write_text("% program : RTKPOST\n")
    with pytest.raises(NotALog, match="no exposure"):
        read_log(tmp_path / "a.pos")


def test_heic_pictures_are_named(tmp_path):
    (tmp_path / "IMG_1.HEIC").write_bytes(b"\0\0\0\x18ftypheic" + bytes(100))
    (rejection,) = survey([tmp_path]).rejected
    assert "convert them to JPEG" in rejection.reason
