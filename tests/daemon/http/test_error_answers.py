"""What a request is told when the system fails under it."""

import asyncio
from pathlib import Path

import httpx
import pytest
from fastapi import FastAPI

from gcs_plugin.web.answers import JsonAnswer, install_error_answers

FULL = Path("/dev/full")


def answered(route) -> httpx.Response:
    app = FastAPI()
    install_error_answers(app)
    app.add_api_route("/", route, methods=["POST"])

    async def ask() -> httpx.Response:
        transport = httpx.ASGITransport(app, raise_app_exceptions=False)
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1") as client:
            return await client.post("/")

    return asyncio.run(ask())


@pytest.mark.skipif(not FULL.exists(), reason="a device that is always full")
def test_a_disk_that_is_full_anywhere_is_told_in_words():
    answer = answered(lambda: FULL.write_text("a plan"))
    assert answer.status_code == 507
    assert answer.json()["detail"] == "the disk is full; free some space and send it again"


def test_other_failures_of_the_system_are_not_taken_for_a_full_disk(tmp_path):
    assert answered(lambda: (tmp_path / "absent").read_text()).status_code == 500


def test_a_number_that_is_none_is_null_and_no_failure():
    answer = answered(lambda: JsonAnswer({"lat_deg": float("nan"), "sigma_m": [float("inf"), 1.5], "name": "\ud800"}))
    assert answer.status_code == 200
    assert answer.text == '{"lat_deg":null,"sigma_m":[null,1.5],"name":"\\ud800"}'
