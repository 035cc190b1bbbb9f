"""Uploads are answered when they are on the disk, however many pictures wait to be drawn."""

import asyncio
from pathlib import Path

import httpx

from gcs_plugin.daemon.daemon import Daemon
from gcs_plugin.daemon.intake.posted_pose import frame_of, parse_pose
from gcs_plugin.daemon.settings import Settings
from gcs_plugin.daemon.store.daemon_events import PictureStored
from gcs_plugin.web.app import make_app
from gcs_plugin.web.guard import Access
from tests.kit.daemon_kit import SIZE, Shot, camera_at, form, jpeg, pose_of

_WAITING = 1900


def test_an_upload_does_not_wait_for_pictures_that_are_to_be_drawn(tmp_path: Path) -> None:
    daemon = Daemon(Settings(workspace=tmp_path / "w"))  # not started: nothing is drawn
    try:
        for k in range(_WAITING):
            values = parse_pose(pose_of(camera_at(12.0 * k), f"{k}.jpg")).values
            path = tmp_path / f"{k}.jpg"
            frame = frame_of(values, image=path.name, path=path, vehicle="v1", time_s=float(k), size=SIZE)
            daemon.drawer.picture_stored(
                PictureStored(seq=10_000 + k, frame=frame, arrived_s=float(k), sortie=1, has_fix=True, count=k + 1)
            )
        assert daemon.drawer.backlog == _WAITING

        async def upload() -> int:
            transport = httpx.ASGITransport(make_app(daemon, Access("a-token-of-tests")))
            async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
                shot = Shot(pose_of(camera_at(), "new.jpg", "v2"), jpeg(camera_at()))
                async with asyncio.timeout(120.0):
                    return (await client.post("/api/frames", **form(shot))).status_code

        assert asyncio.run(upload()) == 201
        assert [row["image"] for row in daemon.views.frames("v2")] == ["new.jpg"]
    finally:
        daemon.close()
