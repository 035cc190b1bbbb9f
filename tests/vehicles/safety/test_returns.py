"""Giving the commands of a return in turn: who is told what, also when others command meanwhile."""

import threading
import time
from concurrent.futures import Future

import pytest

from gcs_plugin.fleet.separation.returns import Returns
from tests.vehicles.safety.test_return_order import FAN, flown_out


class Station:
    """Stands for the daemon's fleet: vehicles in simulated time, and a record of the commands."""

    def __init__(self, world):
        self.world, self.fleet, self.heard, self.published = world, self, [], []
        self.vehicles, self.outcomes, self.lock = world.fleet.vehicles, {}, threading.Lock()
        self.told_now = {verb: threading.Event() for verb in ("pause", "rtl")}
        self.may_answer = {verb: threading.Event() for verb in ("pause", "rtl")}
        for answered in self.may_answer.values():
            answered.set()

    def call(self, work):
        future = Future()
        with self.lock:
            future.set_result(work())
        return future

    def send(self, system, messages):
        self.world.fleet.send(system, messages)

    def command(self, verb, names):
        self.heard.append((verb, tuple(sorted(names))))
        self.told_now[verb].set()
        assert self.may_answer[verb].wait(120.0)
        return [{"vehicle": n, "outcome": self.outcomes.get((verb, n), "done"), "reason": ""} for n in names]

    def told(self, verb):
        return {name for each, names in self.heard if each == verb for name in names}


def until(done, limit_s=120.0):
    end = time.monotonic() + limit_s
    while not done() and time.monotonic() < end:
        time.sleep(0.01)
    assert done()


@pytest.fixture
def station(make_world):
    world, _ = flown_out(make_world, FAN[:4])
    made = Station(world)
    made.returns = Returns(made, made.command, made.published.append, lambda system: f"v{system}")
    made.systems = {f"v{system}": system for system in made.vehicles}
    yield made
    made.returns.close()


def test_those_that_hold_are_told_at_once_though_another_does_not_answer(station):
    station.returns.close()  # nobody's turn comes afterwards: what `begin` does is looked at
    station.may_answer["rtl"].clear()
    begin = threading.Thread(target=station.returns.begin, args=(station.systems, "n"))
    begin.start()
    assert all(told.wait(120.0) for told in station.told_now.values())  # though nobody answers the one
    station.may_answer["rtl"].set()
    begin.join()
    assert station.told("pause").isdisjoint(station.told("rtl"))
    assert set(station.returns.waits()) == station.told("pause")


def test_what_others_command_meanwhile_stands(station):
    station.returns.close()  # nobody's turn comes afterwards: what `begin` does is looked at
    station.may_answer["pause"].clear()
    done = []
    begin = threading.Thread(target=lambda: done.append(station.returns.begin(station.systems, "n")))
    begin.start()
    assert station.told_now["pause"].wait(120.0)
    held = sorted(station.told("pause"))
    for name in held:  # the operator lands all: their pauses end without success
        station.outcomes["pause", name] = "not_sent"
        station.returns.cancel(station.systems[name])
    station.may_answer["pause"].set()
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


def test_one_that_comes_home_by_itself_waits_no_longer_and_that_is_said(station):
    station.returns.begin(station.systems, "n")
    held = sorted(station.returns.waits())[0]
    with station.lock:
        station.world.vehicles[station.systems[held]].flight.set_mode(9)  # LAND, by its remote control
        station.world.wait(5.0)
    until(lambda: any(row["vehicle"] == held for row in station.published))
    row = next(row for row in station.published if row["vehicle"] == held)
    assert (row["outcome"], row["reason"]) == ("done", f"{held} returns or lands already")
    assert held not in station.returns.waits() and held not in station.told("rtl")


def test_a_home_that_is_not_known_yet_is_waited_for(station):
    vehicles = station.vehicles
    homes = {system: vehicle.home for system, vehicle in vehicles.items()}
    for vehicle in vehicles.values():
        vehicle.home = vehicle.launch = None
    begin = threading.Thread(target=station.returns.begin, args=(station.systems, "n"))
    begin.start()
    with station.lock:  # they are asked, and answer
        for system, home in homes.items():
            vehicles[system].home = home
    begin.join()
    assert station.told("pause") and set(station.returns.waits()) == station.told("pause")
