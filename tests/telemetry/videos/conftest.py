"""A memory card's folder, and the frames of it."""

import pytest

from telemetry.ingest.ingest import LoadOptions, load


@pytest.fixture
def mapped(tmp_path):
    """Loads a folder, a picture a second."""

    def run(folder, every_s=1.0):
        return load([folder], options=LoadOptions(cache=tmp_path / "cache", every_s=every_s))

    return run


@pytest.fixture
def card(tmp_path):
    folder = tmp_path / "card"
    folder.mkdir()
    return folder
