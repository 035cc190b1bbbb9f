"""The examples of docs/api.md run as they stand, one after the other; and the face has what it says."""

import dataclasses
import importlib
import json
import re
from pathlib import Path

import pytest

from gcs_plugin.sim.simulated_swarm import SimSwarm, make_swarm
from tests.kit.scene import Scene, legs
from tests.telemetry.videos.video_files import write_srt, write_video
from tests.vehicles.autopilots.test_twin_camera import small_area

TEXT = (Path(__file__).parents[2] / "docs" / "api.md").read_text(encoding="utf-8")
EXAMPLES = re.findall(r"```python\n(.*?)```", TEXT, flags=re.DOTALL)


@pytest.mark.parametrize("package", ["orthoswarm", "telemetry", "gcs_plugin"])
def test_all_names_of_the_face_are_there_and_documented(package):
    face = importlib.import_module(package)
    assert all(getattr(face, name).__doc__ or name == "Progress" for name in face.__all__)
    for record in filter(dataclasses.is_dataclass, (getattr(face, name) for name in face.__all__)):
        explained = record.__doc__.partition("Attributes:")[2]
        assert [f.name for f in dataclasses.fields(record) if not re.search(rf"\b{f.name}\b", explained)] == [], record
    with pytest.raises(AttributeError):
        face.no_such_name  # noqa: B018
    assert (Path(face.__file__).parent / "py.typed").exists()


def test_the_examples_run(tmp_path, monkeypatch, capsys):
    scene = Scene()
    scene.fly(tmp_path / "photos" / "a", legs(count=2, photos=6))
    scene.basemap(tmp_path / "before.tif")
    write_srt(write_video(tmp_path / "flight.mp4", count=60).with_suffix(".srt"), seconds=6)
    (tmp_path / "town.geojson").write_text(json.dumps(small_area(47.4, 8.5)))
    monkeypatch.chdir(tmp_path)
    vehicles = make_swarm(1, home=(47.4, 8.5, 400.0))
    with SimSwarm(vehicles, "tcpin:127.0.0.1:0") as swarm:
        for example in EXAMPLES:
            exec(example.replace("udpin:127.0.0.1:14550", swarm.addresses[0]), {})
    said = capsys.readouterr().out
    assert len(EXAMPLES) == 6 and "12 pictures in" in said
    assert float(re.search(r"([\d.]+) m\n", said)[1]) < 1.0
    assert "flight.mp4#" in said and "holds" in said.splitlines()[-1]
    assert (tmp_path / "sketch" / "realtime.tif").exists() and (tmp_path / "missions" / "v2.plan").exists()
