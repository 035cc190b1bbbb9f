"""Fixtures of the tests with vehicles."""

from dataclasses import replace

import pytest

from gcs_plugin.backends import backend
from gcs_plugin.config import HEARING
from gcs_plugin.fleet import autopilot_settings, fleet
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


@pytest.fixture
def in_vehicle_time(monkeypatch):
    """The fleet asks as much faster as vehicles run here, and expects no further one after as many heartbeats."""
    monkeypatch.setattr(autopilot_settings, "_PAUSE_S", 0.025)
    monkeypatch.setattr(fleet, "_TICK_S", 0.025)
    monkeypatch.setattr(backend, "HEARING", replace(HEARING, all_found_s=0.5))
