"""Ninety-six vehicles on one ground station: messages lost, and the share of a core that it takes.

Simulated vehicles in a process of their own send 10 Hz of position and 10 Hz of attitude each over UDP (and seven
slower messages a second), every message in a datagram and every vehicle from a port of its own. The fleet finds them,
asks for the streams, decodes and follows every message, and writes the telemetry log. After a warm-up its own processor
time is measured, user and system.

    python -m benchmarks.speed.fleet96 [--vehicles 96] [--seconds 30] [--link udp|tcp] [--json]
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(ROOT))


def simulate(count: int, port: int, link: str, seconds: float) -> None:
    from gcs_plugin.links.mavlink import Autopilot
    from gcs_plugin.sim.simulated_swarm import SimSwarm, make_swarm

    address = f"udpout:127.0.0.1:{port}" if link == "udp" else f"tcpin:127.0.0.1:{port}"
    vehicles = make_swarm(count, autopilots=(Autopilot.ARDUPILOT, Autopilot.PX4))
    swarm = SimSwarm(vehicles, address, together=link == "tcp")
    swarm.run(threading.Event(), until_s=seconds)
    swarm.close()


def measure(count: int, seconds: float, link: str) -> dict[str, Any]:
    from gcs_plugin.fleet.fleet import Fleet
    from gcs_plugin.links.transports import TcpLink, UdpLink

    warm_up_s = 15.0
    if link == "udp":
        opened: Any = UdpLink("udpin:127.0.0.1:0", "127.0.0.1", 0, listens=True)
        port = opened.port
    else:
        probe = TcpLink("tcpin:127.0.0.1:0", "127.0.0.1", 0, serves=True)
        port = probe.port
        probe._server.close()  # type: ignore[union-attr]
        opened = f"tcp:127.0.0.1:{port}"
    command = [sys.executable, __file__, "--simulate", str(port), "--vehicles", str(count), "--link", link]
    command += ["--seconds", str(seconds + warm_up_s + 15.0)]
    with tempfile.TemporaryDirectory() as folder, subprocess.Popen(command) as child:
        fleet = Fleet([opened], tlog=Path(folder) / "fleet.tlog")
        counted = {"GLOBAL_POSITION_INT": 0, "ATTITUDE": 0}

        def count_message(vehicle: Any, message: Any, utc_s: float) -> None:
            counted[message.get_type()] += 1

        fleet.subscribe(count_message, *counted)
        try:
            found = fleet.run_until(lambda: len(fleet.vehicles) == count, 30.0)
            stop = threading.Event()
            runner = threading.Thread(target=fleet.run, args=(stop,))
            runner.start()
            time.sleep(warm_up_s)
            before, cpu, wall = dict(counted), os.times(), time.monotonic()
            missed = fleet.call(lambda: sum(v.missed for v in fleet.vehicles.values())).result()
            time.sleep(seconds)
            after, wall = os.times(), time.monotonic() - wall
            user, system = after.user - cpu.user, after.system - cpu.system
            missed = fleet.call(lambda: sum(v.missed for v in fleet.vehicles.values())).result() - missed
            stop.set()
            runner.join()
        finally:
            child.kill()
            fleet.close()
    rates = {name: (counted[name] - before[name]) / wall for name in counted}
    return {
        "vehicles": len(fleet.vehicles),
        "all_found": found,
        "link": link,
        "messages_per_s": {name: round(rate, 1) for name, rate in rates.items()},
        "lost": missed,
        "core_share": round((user + system) / wall, 4),
        "user_share": round(user / wall, 4),
        "system_share": round(system / wall, 4),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vehicles", type=int, default=96)
    parser.add_argument("--seconds", type=float, default=30.0)
    parser.add_argument("--link", choices=["udp", "tcp"], default="udp")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--simulate", type=int, metavar="PORT", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.simulate is not None:
        simulate(args.vehicles, args.simulate, args.link, args.seconds)
        return
    result = measure(args.vehicles, args.seconds, args.link)
    if args.json:
        print(json.dumps(result))
        return
    rates = ", ".join(f"{name} {rate}/s" for name, rate in result["messages_per_s"].items())
    print(f"{result['vehicles']} vehicles over {result['link']}: {rates}")
    print(f"lost {result['lost']} messages; {100 * result['core_share']:.1f} % of a core")


if __name__ == "__main__":
    main()
