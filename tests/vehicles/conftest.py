"""Fixtures of the tests with vehicles."""

import pytest

from gcs_plugin.sim.simulated_swarm import Faults
from tests.kit.vehicles.memory_link import World


@pytest.fixture
def make_world():
    """Makes worlds of simulated vehicles and a fleet, in virtual time; ends them after the test."""
    worlds = []

    def make(*vehicles, up=None, down=None, **options):
        worlds.append(World(vehicles, up or Faults(), down or Faults(), **options))
        return worlds[-1]

    yield make
    for world in worlds:
        world.fleet.close()
