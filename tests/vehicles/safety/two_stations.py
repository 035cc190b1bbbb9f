"""Random days at the field: our station, another one, remote controls and failsafes on simulated vehicles.

Everything happens in virtual time and from one seed. What the vehicles truly do and are told is kept by themselves
(`Witness`); whether our station kept its rules is judged in `station_rules`.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from random import Random

from gcs_plugin.fleet.commands import Order
from gcs_plugin.fleet.separation.takeoff_schedule import TakeoffSchedule
from gcs_plugin.links.mavlink import Autopilot, dialect
from gcs_plugin.mission.exchange import GROUND_STATION, Address
from gcs_plugin.mission.flight_modes import mode_params
from gcs_plugin.mission.items import CHANGE_SPEED, LAND, RTL, TAKEOFF, WAYPOINT, Mission, MissionItem
from gcs_plugin.sim.multirotor import Chart
from gcs_plugin.sim.simulated_swarm import Faults
from gcs_plugin.sim.simulated_vehicle import SimVehicle
from orthoswarm.model.errors import OrthoSwarmError
from tests.kit.vehicles.memory_link import World

AP, PX4 = Autopilot.ARDUPILOT, Autopilot.PX4
OTHER = Address(254, 190)
STEP_S = 0.05
LOITER = {AP: 5, PX4: 3 << 16}  # PX4: POSCTL
BY_HAND = {AP: 0, PX4: 7 << 16}
ARM, START = int(dialect.MAV_CMD_COMPONENT_ARM_DISARM), int(dialect.MAV_CMD_MISSION_START)
SET_MODE, CURRENT = int(dialect.MAV_CMD_DO_SET_MODE), int(dialect.MAV_CMD_DO_SET_MISSION_CURRENT)
HOME, DOWN = int(dialect.MAV_CMD_NAV_RETURN_TO_LAUNCH), int(dialect.MAV_CMD_NAV_LAND)
UPLOAD = -1  # no command: another station stores a mission
ENDINGS = ("rtl", "land", "waypoint")
PAUSE = int(dialect.MAV_CMD_DO_PAUSE_CONTINUE)


@dataclass(frozen=True, slots=True)
class Told:
    """What a vehicle obeyed: when, of which system (its own: remote control, failsafe), its mode before and after."""

    at: float
    by: int
    command: int
    params: tuple[float, ...]
    was: int
    mode: int


class Witness(SimVehicle):
    """A simulated vehicle that keeps what it obeyed, and where it was.

    Attributes:
        told: commands that it obeyed. stops: those of others, of its remote control and of itself that end a flight.
        path: (time, north, east) since it was armed last. heights: (time, up) always.
        stored: (time, items) at each change of its mission.
    """

    def __init__(self, **options):
        super().__init__(**options)
        self.told, self.stops, self.path, self.stored = [], [], [], []
        self.heights = []
        self._held, self._armed = None, False

    def handle(self, message, sender, now):
        was, off = self.flight.mode, self.off
        answers = super().handle(message, sender, now)
        if message.get_type() == "COMMAND_LONG" and not off:
            acks = [m for m in answers if m.get_type() == "COMMAND_ACK"]
            if acks and acks[0].result == dialect.MAV_RESULT_ACCEPTED:
                params = tuple(getattr(message, f"param{n}") for n in range(1, 4))
                told = Told(now, sender.system, int(message.command), params, was, self.flight.mode)
                self.told.append(told)
                if sender.system != GROUND_STATION.system and self._is_stop(told):
                    self.stops.append(told)
        if message.get_type() == "MISSION_COUNT" and sender.system != GROUND_STATION.system:
            self.told.append(Told(now, sender.system, UPLOAD, (), was, was))
        return answers

    def by_itself(self, now, do):
        """Something that its remote control or its autopilot does."""
        was = self.flight.mode
        do()
        told = Told(now, self.system, SET_MODE, (), was, self.flight.mode)
        self.told.append(told)
        if self._is_stop(told):
            self.stops.append(told)

    def _is_stop(self, told):
        modes = self.flight.modes
        paused = told.command == PAUSE and told.params[0] == 0.0
        stays = told.mode in (modes.rtl, modes.land, modes.hold, LOITER[self.autopilot])
        return paused or (told.command in (HOME, DOWN, SET_MODE) and stays)

    def advance(self, now):
        messages = super().advance(now)
        motion, armed = self.flight.motion, self.flight.armed
        if armed and not self._armed:
            self.path.clear()
        self._armed = armed
        self.path.append((now, motion.north, motion.east))
        self.heights.append((now, motion.up))
        held = tuple(self.store.items)
        if held != self._held:
            self._held = held
            self.stored.append((now, held))
        return messages

    def held_since(self, since):
        """The missions that it held at some time since then."""
        recent = [items for at, items in self.stored if at >= since]
        before = [items for at, items in self.stored if at < since]
        return before[-1:] + recent

    def missed(self, items, near_m):
        """How many places of a mission it did not come so near to on this flight; None without places."""
        places = [i for i in items[self.autopilot is AP :] if i.command == WAYPOINT]
        spots = [self.flight.motion.chart.to_metres(place.lat_deg, place.lon_deg) for place in places]
        away = [min((math.hypot(n - north, e - east) for _, n, e in self.path), default=99.0) for north, east in spots]
        return sum(metres > near_m for metres in away) if places else None


def short_mission(vehicle, mirrored=False, ending="rtl", height_m=8.0, hold_s=0.0):
    """A flight of half a minute over three places; mirrored: to three others, with as many items."""
    chart, sign = Chart(*vehicle.home), -1.0 if mirrored else 1.0
    yaw = 0.0 if vehicle.autopilot is AP else math.nan

    def at(command, north, east, height=height_m, hold=0.0):
        return MissionItem.at(command, *chart.to_degrees(north, east), height, params=(hold, 0.0, 0.0, yaw))

    items = [at(WAYPOINT, 0, 0)] if vehicle.autopilot is AP else []
    items += [at(TAKEOFF, 0, 0), MissionItem.do(CHANGE_SPEED, 1, 8)]
    items += [at(WAYPOINT, sign * n, sign * e, hold=hold_s) for n, e in ((25.0, 0.0), (25.0, 20.0), (0.0, 20.0))]
    end = {"rtl": MissionItem.do(RTL), "land": at(LAND, 0, 0, 0.0), "waypoint": at(WAYPOINT, 0, 0)}
    return Mission(vehicle.autopilot, (*items, end[ending]))


class OtherStation:
    """A station of its own, whose messages arrive at once.

    Args:
        world: with the vehicles. shared: whether our station hears what the vehicles answer it.
    """

    def __init__(self, world, shared):
        self.world, self.shared = world, shared

    def say(self, vehicle, message):
        now, peer = self.world.clock.now, list(self.world.vehicles).index(vehicle.system)
        answers = vehicle.handle(message, OTHER, now)
        ours = [m for m in answers if self.shared or getattr(m, "target_system", 0) != OTHER.system]
        self.world.link._say(peer, ours, now)
        return answers

    def command(self, vehicle, command, *params):
        values = (*params, *(0.0,) * 7)[:7]
        self.say(vehicle, dialect.MAVLink_command_long_message(vehicle.system, 1, command, 0, *values))

    def mode(self, vehicle, mode):
        self.command(vehicle, SET_MODE, *mode_params(vehicle.autopilot, mode))

    def upload(self, vehicle, mission):
        """Its steps: the mission, item by item as the vehicle asks for them."""
        answers = self.say(vehicle, dialect.MAVLink_mission_count_message(vehicle.system, 1, len(mission.items), 0))
        while wanted := [m for m in answers if m.get_type() in ("MISSION_REQUEST", "MISSION_REQUEST_INT")]:
            yield
            seq = int(wanted[0].seq)
            answers = self.say(vehicle, mission.items[seq].message(seq, vehicle.system, 1))


@dataclass(eq=False)
class Given:
    """A start that was given: the order, when, and what it relied on."""

    order: Order
    at: float
    stops: int
    standing: object
    mission: Mission | None


@dataclass(eq=False)
class Plan:
    """Takeoffs with waits, as `backends.backend.command_all` and `daemon.takeoffs` have them."""

    schedule: TakeoffSchedule
    at: float
    planned: dict[int, float]
    stops: dict[int, int]
    standing: dict[int, object]
    missions: dict[int, Mission]
    orders: dict[int, Order] = field(default_factory=dict)
    decided: set[int] = field(default_factory=set)
    cancelled: set[int] = field(default_factory=set)

    @property
    def over(self):
        return not self.schedule.waiting and self.decided >= self.orders.keys()


class Field:
    """A world with its actors, in which things happen at random.

    Attributes:
        given: starts by system id. plans: all so far. resumes: (time, system) of commands to go on.
        orders: all of our station.
    """

    def __init__(self, seed):
        self.random = random = Random(seed)
        homes = [(47.397742, 8.545594 + 0.0008 * number, 488.0) for number in range(random.choice((2, 2, 3)))]
        vehicles = [Witness(system=n, autopilot=random.choice((AP, PX4)), home=home) for n, home in enumerate(homes, 1)]
        self.delay_s = random.choice((0.0, 0.0, 0.1, 0.3))
        faults = [Faults(seed=random.randrange(1 << 30)) for _ in range(2)]
        self.world = World(vehicles, *faults)
        self.vehicles, self.fleet = vehicles, self.world.fleet
        self.other = OtherStation(self.world, shared=random.random() < 0.5)
        self.given: dict[int, list[Given]] = {v.system: [] for v in vehicles}
        self.plans: list[Plan] = []
        self.orders: list[Order] = []
        self.went_on: dict[int, float] = {}
        self.missions = {v.system: self._mission(v) for v in vehicles}
        self.log: list[str] = []
        self._later: list[tuple[float, float, Iterator[None]]] = []  # uploads of the other station: when, how often
        self.fleet.takeoffs = self

    def __contains__(self, system):
        """Whether a vehicle's takeoff waits."""
        return any(system in plan.schedule.waiting for plan in self.plans)

    @property
    def now(self):
        return self.world.clock.now

    def prepare(self):
        """Missions are uploaded over a good link; from then on it is as bad as it is."""
        random, world = self.random, self.world
        world.meet()
        uploads = [self.fleet.upload(v.system, self.missions[v.system]) for v in self.vehicles]
        assert all(outcome.ok for outcome in world.finish(*uploads))
        for channel in (world.link.up, world.link.down):
            silent = []
            for _ in range(random.choice((0, 0, 0, 1, 2))):
                begin = self.now + random.uniform(0.0, 30.0)
                silent.append((begin, begin + random.uniform(1.0, 6.0)))
            loss, delay = random.choice((0.0, 0.1, 0.2, 0.3)), (self.delay_s, self.delay_s)
            channel.faults = replace(channel.faults, loss=loss, delay_s=delay, silent=tuple(silent))

    def run(self, look: Callable[[], None], busy_s=30.0, limit_s=80.0):
        """Let things happen for so long, and then until the vehicles have come to rest."""
        begin, still = self.now, 0.0
        self.start_plan()
        next_at = self.now + self.random.choice((self.random.uniform(0.2, 4.0), self.random.uniform(6.0, 14.0)))
        while self.now - begin < limit_s and still < 8.0:
            self.world.clock.now += STEP_S
            self.fleet.poll(0.0)
            self._follow_plans()
            self._go_on_uploading()
            look()
            if self.now >= next_at and self.now - begin < busy_s:
                self.act()
                next_at = self.now + self.random.choice((0.15, 0.4, 1.0, 2.0, 4.0, 6.0)) * self.random.uniform(0.5, 1.5)
            rests = self.now - begin >= busy_s and all(p.over for p in self.plans) and all(map(_rests, self.vehicles))
            still = still + STEP_S if rests else 0.0

    # --- our station ---

    def start_plan(self):
        """Start all that stand, one after the other."""
        fleet, now = self.fleet, self.now
        if any(not plan.over for plan in self.plans):
            return
        systems = [v.system for v in self.vehicles if not fleet.vehicles[v.system].flying]
        self.random.shuffle(systems)
        delays, at = {}, 0.0
        for system in systems:
            delays[system] = at
            at += self.random.uniform(0.0, 9.0)
        self.log.append(f"{now:.2f} plan {delays}")
        standing = {s: fleet.vehicles[s].standing for s in systems}
        missions = {s: self.missions[s] for s in systems}
        schedule = TakeoffSchedule.of(delays, now)
        planned = dict(schedule.waiting)
        self.plans.append(Plan(schedule, now, planned, dict(fleet.stops), standing, missions))

    def _follow_plans(self):
        for plan in self.plans:
            for system in plan.schedule.due(self.now):
                stops, standing, mission = plan.stops.get(system, 0), plan.standing[system], plan.missions[system]
                plan.orders[system] = self._start(system, plan.at, stops, standing, mission)
            for system, order in list(plan.orders.items()):
                if order.outcome is None or system in plan.decided:
                    continue
                plan.decided.add(system)
                self.log.append(f"{self.now:.2f} start {system}: {order.outcome.text}")
                if order.outcome.ok:
                    plan.schedule.started(system, self.now, str, order.begun_s)
                else:
                    plan.schedule.failed(system)

    def _start(self, system, at, stops, standing, mission):
        order = Order(
            verb="start", system=system, given_s=self.now, stops=stops, standing=standing, mission=mission
        )  # fmt: skip
        self.given[system].append(Given(order, at, stops, standing, mission))
        self.orders.append(self.fleet.order(order))
        return order

    def order(self, verb, system):
        self.log.append(f"{self.now:.2f} we {verb} {system}")
        if verb in ("pause", "rtl", "land"):
            for plan in self.plans:
                if plan.schedule.waiting.pop(system, None) is not None:
                    plan.cancelled.add(system)
        if verb in ("resume", "continue"):
            self.went_on[system] = self.now
        if verb == "start":
            vehicle = self.fleet.vehicles[system]
            mission = self.random.choice((self.missions[system], None))
            if system not in self:
                self._start(system, self.now, self.fleet.stops.get(system, 0), vehicle.standing, mission)
            return
        order = self.fleet.order(Order(verb=verb, system=system, given_s=self.now))
        self.orders.append(order)
        if order.outcome is not None:
            self.log.append(f"   -> {order.outcome.text}")

    def upload(self, vehicle):
        self.log.append(f"{self.now:.2f} we upload to {vehicle.system}")
        mission = self._mission(vehicle)
        try:
            self.fleet.upload(vehicle.system, mission)
            self.missions[vehicle.system] = mission
        except OrthoSwarmError as error:
            self.log.append(f"   -> {error}")

    def _mission(self, vehicle):
        return short_mission(vehicle, ending=self.random.choice(ENDINGS), height_m=self.random.choice((8.0, 14.0)))

    # --- everybody ---

    def act(self):
        """One thing that somebody does to one vehicle."""
        vehicle = self.random.choice(self.vehicles)
        who = self.random.choices(("we", "other", "pilot", "fate"), (5, 5, 3, 1))[0]
        getattr(self, f"_{who}")(vehicle)

    def _we(self, vehicle):
        verbs = ("start", "pause", "resume", "continue", "rtl", "land", "upload", "plan")
        verb = self.random.choices(verbs, (4, 3, 4, 1, 2, 1, 2, 2))[0]
        if verb == "plan":
            self.start_plan()
        elif verb == "upload":
            self.upload(vehicle)
        else:
            self.order(verb, vehicle.system)

    def _other(self, vehicle):
        other, modes, last = self.other, vehicle.flight.modes, len(vehicle.store.items) - 1
        deeds = {
            "rtl": lambda: other.command(vehicle, HOME),
            "land": lambda: other.command(vehicle, DOWN),
            "hold": lambda: other.mode(vehicle, modes.hold),
            "loiter": lambda: other.mode(vehicle, LOITER[vehicle.autopilot]),
            "guided": lambda: other.mode(vehicle, modes.ready),
            "fly away": lambda: self._fly_away(vehicle),
            "pause": lambda: other.command(vehicle, PAUSE, 0.0),
            "go on": lambda: other.mode(vehicle, modes.mission),
            "start": lambda: other.command(vehicle, START),
            "arm": lambda: other.command(vehicle, ARM, 1.0),
            "disarm": lambda: other.command(vehicle, ARM, 0.0),
            "last item": lambda: other.command(vehicle, CURRENT, float(last)),
            "first item": lambda: other.command(vehicle, CURRENT, 0.0),
            "upload": lambda: self._uploads(vehicle),
        }
        deed = self.random.choices(list(deeds), (5, 2, 3, 2, 2, 4, 2, 2, 1, 2, 1, 3, 1, 4))[0]
        self.log.append(f"{self.now:.2f} other {deed} {vehicle.system}")
        deeds[deed]()

    def _uploads(self, vehicle):
        steps = self.other.upload(vehicle, short_mission(vehicle, mirrored=True))
        self._later.append((self.now, self.random.choice((0.0, 0.0, 0.1, 0.2)), steps))

    def _go_on_uploading(self):
        later, self._later = self._later, []
        for at, every_s, steps in later:
            goes_on = True
            while goes_on and at <= self.now:
                goes_on, at = next(steps, "ended") is None, at + every_s
            if goes_on:
                self._later.append((at, every_s, steps))

    def _fly_away(self, vehicle):
        self.other.mode(vehicle, vehicle.flight.modes.ready)
        course = self.random.uniform(0.0, 2.0 * math.pi)
        vehicle.flight.steer(10.0 * math.cos(course), 10.0 * math.sin(course), 0.0)

    def _pilot(self, vehicle):
        flight, modes = vehicle.flight, vehicle.flight.modes
        low, loiter = self.random.choice((-0.8, -1.5)), LOITER[vehicle.autopilot]
        mode, sinks = self.random.choice((
            (loiter, 0.0), (loiter, low), (loiter, low), (BY_HAND[vehicle.autopilot], 0.0), (modes.rtl, 0.0),
            (modes.land, 0.0),
        ))  # fmt: skip
        self.log.append(f"{self.now:.2f} pilot {vehicle.system} {modes.name(mode)} {sinks}")
        vehicle.by_itself(self.now, lambda: flight.set_mode(mode))
        if sinks:
            flight.steer(0.0, 0.0, sinks)

    def _fate(self, vehicle):
        deed = self.random.choice(("failsafe", "failsafe", "reboot", "carried"))
        self.log.append(f"{self.now:.2f} {deed} {vehicle.system}")
        if deed == "failsafe" and vehicle.flight.armed:
            vehicle.by_itself(self.now, lambda: vehicle.flight.fail_safe("Battery Failsafe"))
        elif deed == "reboot":
            vehicle.reboot(self.now, self.random.uniform(1.0, 4.0))
        elif deed == "carried" and not vehicle.flight.armed:
            vehicle.flight.motion.north += 30.0


def _rests(vehicle):
    motion = vehicle.flight.motion
    return math.hypot(motion.vn, motion.ve) < 0.1 and abs(motion.vu) < 0.1
