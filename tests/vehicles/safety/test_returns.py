"""Giving the commands of a return in turn: who is told what, also when others command meanwhile."""

import threading
import time
from concurrent.futures import Future

import pytest

from gcs_plugin.daemon.airspace.returns import Returns
from tests.vehicles.safety.test_return_order import FAN, flown_out


class Station:
    """Stands for the daemon's fleet: vehicles in simulated time, and a record of the commands."""

    def __init__(self, world):
        self.world, self.fleet, self.heard, self.published = world, self, [], []
        self.vehicles, self.outcomes, self.slow, self.lock = world.fleet.vehicles, {}, {}, threading.Lock()

    def call(self, work):
        future = Future()
        with self.lock:
            future.set_result(work())
        return future

    def ask_settings(self, system):
        self.world.fleet.ask_settings(system)

    def command(self, verb, names):
        self.heard.append((verb, tuple(sorted(names))))
        time.sleep(self.slow.get(verb, 0.0))
        return [{"vehicle": n, "outcome": self.outcomes.get((verb, n), "done"), "reason": ""} for n in names]

    def told(self, verb):
        return {name for each, names in self.heard if each == verb for name in names}


@pytest.fixture
def station(make_world):
    world, _ = flown_out(make_world, FAN[:4])
    made = Station(world)
    made.returns = Returns(made, made.command, made.published.append, lambda system: f"v{system}")
    made.systems = {f"v{system}": system for system in made.vehicles}
    yield made
    made.returns.close()


def test_those_that_hold_are_told_at_once_though_another_does_not_answer(station):
    station.slow["rtl"] = 1.0
    begin = threading.Thread(target=station.returns.begin, args=(station.systems, "n"))
    begin.start()
    time.sleep(0.5)
    assert station.told("pause") and station.told("rtl")
    begin.join()
    assert station.told("pause").isdisjoint(station.told("rtl"))
    assert set(station.returns.waits()) == station.told("pause")


def test_what_others_command_meanwhile_stands(station):
    station.slow["pause"] = 0.5
    done = []
    begin = threading.Thread(target=lambda: done.append(station.returns.begin(station.systems, "n")))
    begin.start()
    time.sleep(0.2)
    held = sorted(station.told("pause"))
    for name in held:  # the operator lands all: their pauses end without success
        station.outcomes["pause", name] = "not_sent"
        station.returns.cancel(station.systems[name])
    begin.join()
    assert not station.told("rtl") & set(held)
    assert station.returns.waits() == {}
    said = {row["vehicle"]: row for row in done[0]}
    assert len(said) == 4 and all(row["command"] == "return" for row in said.values())


def test_one_that_does_not_acknowledge_its_return_has_its_turn_again(station):
    for name in station.systems:
        station.outcomes["rtl", name] = "unknown"
    rows = station.returns.begin(station.systems, "n")
    assert {row["outcome"] for row in rows} == {"unknown", "done"}
    assert set(station.returns.waits()) == set(station.systems)
