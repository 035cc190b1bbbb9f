"""What several tests of jobs fly."""

import pytest

from tests.kit.made_up_ground import made_up_flight, made_up_ground, write_map


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """Frames as taken, and the map's file."""
    folder = tmp_path_factory.mktemp("flight")
    ground = made_up_ground()
    write_map(ground, folder / "map.tif")
    return made_up_flight(ground, folder, "v1"), folder / "map.tif"
