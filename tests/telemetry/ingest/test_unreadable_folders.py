"""A folder that may not be listed can hold a whole vehicle: it is named, with the reason."""

import os

import pytest

import telemetry
from orthoswarm.model.errors import InputError
from tests.kit.scene import Scene, legs


@pytest.fixture
def locked(monkeypatch):
    """Takes the right to list a folder away, from root, too."""
    real, closed = os.scandir, set()

    def scandir(path="."):
        if os.fspath(path) in closed:
            raise PermissionError(13, "Permission denied", os.fspath(path))
        return real(path)

    monkeypatch.setattr(os, "scandir", scandir)
    return lambda path: closed.add(str(path))


def test_a_vehicle_in_a_locked_folder_is_named(tmp_path, locked):
    scene = Scene()
    scene.fly(tmp_path / "a", legs(count=1, photos=3))
    scene.fly(tmp_path / "b", legs(count=1, photos=2))
    locked(tmp_path / "b")
    found = telemetry.load([tmp_path])
    assert len(found.frames) == 3
    assert any("folder b cannot be read (Permission denied)" in w for w in found.warnings)


def test_a_locked_input_is_said_to_be_locked(tmp_path, locked):
    (tmp_path / "photos" / "b").mkdir(parents=True)
    locked(tmp_path / "photos" / "b")
    with pytest.raises(InputError, match=r"photos.b cannot be read \(Permission denied\)"):
        telemetry.load([tmp_path / "photos"])
    locked(tmp_path / "photos")
    with pytest.raises(InputError, match=r"photos cannot be read \(Permission denied\)"):
        telemetry.load([tmp_path / "photos"])
