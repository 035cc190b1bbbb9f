"""The pack has the log of who did what."""

import io
import time
import zipfile

import pytest

from tests.kit.daemon_kit import form, line, serving


@pytest.mark.slow
def test_the_pack_has_the_log(tmp_path):
    with serving(tmp_path / "post", "--lan", "--bind", "127.0.0.1") as served:
        for shot in line(6):
            assert served.post("/api/frames", headers=served.auth, **form(shot)).status_code == 201
        served.until("/api/frames", lambda rows: len(rows) == 6 and all(row["on_map"] for row in rows))
        find = {"lat_deg": 48.0, "lon_deg": 11.0, "note": "boat"}
        assert served.post("/api/finds", json=find, headers=served.auth).status_code == 201
        job = served.command("/api/export", {"formats": ["pack"]}).json()["id"]
        while (row := _job(served, job))["state"] in ("queued", "running"):
            time.sleep(0.2)
        assert row["state"] == "done", row
        packed = served.get(f"/api/export/{job}/pack", headers=served.auth).content
    with zipfile.ZipFile(io.BytesIO(packed)) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith("/log.csv"))
        lines = archive.read(name).decode().splitlines()
        page = archive.read(next(name for name in archive.namelist() if name.endswith("/index.html"))).decode()
    assert lines[0].startswith("time,name,role,action")
    assert any(",operator,operator,find,,done" in text for text in lines)
    assert "Who did what when" in page


def _job(served, number):
    rows = served.get("/api/jobs", headers=served.auth).json()
    return next(row for row in rows if row["id"] == number)
