"""The page's files are compressed and kept for good; answers in JSON are compressed."""

import json
import re

import pytest

from gcs_plugin.web.app import STATIC
from tests.kit.daemon_kit import line, serving


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    with serving(tmp_path_factory.mktemp("workspace")) as served:
        yield served


@pytest.fixture(scope="module")
def version(served):
    found = re.search(r'src="(/static/v-[0-9a-f]{12}/)app.js"', served.get("/").text)
    assert found is not None
    return found[1]


@pytest.mark.parametrize("name", ["app.js", "vendor/maplibre-gl.mjs", "style/base.css"])
def test_a_file_of_a_version_is_packed_and_kept_for_good(served, version, name):
    answer = served.get(version + name)
    assert answer.content == (STATIC / name).read_bytes()
    assert "immutable" in answer.headers["cache-control"]
    assert answer.headers["content-encoding"] == "gzip"
    assert int(answer.headers["content-length"]) < len(answer.content) / 2
    plain = served.get(version + name, headers={"Accept-Encoding": "identity"})
    assert plain.content == answer.content and "content-encoding" not in plain.headers
    assert answer.headers["content-type"].startswith(("text/javascript", "text/css"))


def test_a_file_without_its_version_is_asked_for_each_time(served, version):
    answer = served.get("/static/app.js")
    assert answer.headers["cache-control"] == "no-cache"
    again = served.get("/static/app.js", headers={"If-None-Match": answer.headers["etag"]})
    assert again.status_code == 304 and again.content == b""
    assert served.get("/static/v-000000000000/app.js").status_code == 404  # of a program that was replaced


def test_the_page_allows_its_own_import_map_and_no_other_script_in_it(served, version):
    page = served.get("/")
    assert page.headers["cache-control"] == "no-cache"
    assert json.loads(re.search(r"importmap\">(.*?)</script>", page.text)[1]) == {"imports": {"/static/": version}}
    (policy,) = page.headers.get_list("content-security-policy")
    assert re.search(r"script-src 'self' 'sha256-[^']+'$", policy) and "unsafe" not in policy.split("script-src")[1]


def test_answers_in_json_are_packed_for_who_takes_it_and_pictures_are_not(served):
    shots = line(12, "many")
    for shot in shots:
        assert served.send(shot).status_code == 201
    packed = served.get("/api/frames")
    plain = served.get("/api/frames", headers={"Accept-Encoding": "identity"})
    assert packed.headers["content-encoding"] == "gzip" and "content-encoding" not in plain.headers
    assert len(packed.json()) == len(plain.json()) == 12
    assert int(packed.headers["content-length"]) < int(plain.headers["content-length"]) / 3
    assert "content-encoding" not in served.get("/api/traffic").headers  # a few bytes
    picture = served.get(f"/api/frames/{packed.json()[0]['seq']}/picture")
    assert picture.content == shots[0].data and "content-encoding" not in picture.headers
