"""What vehicles cost over MAVSDK: messages received and the share of a core, beside our own fleet.

Simulated vehicles in a process of their own are asked for 10 Hz of position and of attitude, as `orthoswarm serve` asks
for them; each message is decoded (MAVSDK hands them over as JSON) and counted.

    python -m benchmarks.speed.mavsdk_load [--vehicles 1 4 8] [--seconds 20]
"""

import argparse
import json
import socket
import subprocess
import sys
import threading
import time
from collections import Counter

WARM_UP_S = 8.0
NAMES = {"GLOBAL_POSITION_INT": 33, "ATTITUDE": 30}


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def with_mavsdk(port: int, count: int, seconds: float) -> tuple[float, int]:
    """CPU seconds and messages over MAVSDK."""
    from mavsdk import Configuration, Mavsdk, log_subscribe
    from mavsdk.plugins.mavlink_direct import MavlinkDirect, MavlinkMessage

    log_subscribe(lambda *_: True)
    sdk, counted, plugins = Mavsdk(Configuration.create_manual(245, 190, True)), Counter[str](), {}

    def take(message: object, _data: object) -> None:
        json.loads(message.fields_json)  # type: ignore[attr-defined]
        counted[message.message_name] += 1  # type: ignore[attr-defined]

    sdk.add_any_connection(f"udpin://127.0.0.1:{port}")
    end = time.monotonic() + WARM_UP_S
    while time.monotonic() < end:
        for system in sdk.get_systems():
            number = int(system.get_system_id())
            if number not in plugins and system.has_autopilot():
                plugins[number] = MavlinkDirect(system)
                for name, kind in NAMES.items():
                    plugins[number].subscribe_message(name, take)
                    ask = {"target_system": number, "target_component": 1, "command": 511, "confirmation": 0}
                    ask |= {"param1": kind, "param2": 100_000, **{f"param{i}": 0 for i in range(3, 8)}}
                    plugins[number].send_message(MavlinkMessage("COMMAND_LONG", 245, 190, number, 1, json.dumps(ask)))
        time.sleep(0.2)
    before, counted_before = time.process_time(), counted.total()
    time.sleep(seconds)
    result = time.process_time() - before, counted.total() - counted_before
    sdk.destroy()
    return result


def with_fleet(port: int, count: int, seconds: float) -> tuple[float, int]:
    """CPU seconds and messages over our own links, all of the fleet's other work included."""
    from gcs_plugin.fleet.fleet import Fleet

    counted, stop = Counter[str](), threading.Event()
    with Fleet([f"udpin:127.0.0.1:{port}"]) as fleet:
        fleet.subscribe(lambda vehicle, message, utc_s: counted.update((message.get_type(),)), *NAMES)
        thread = threading.Thread(target=fleet.run, args=(stop,))
        thread.start()
        time.sleep(WARM_UP_S)
        before, counted_before = time.process_time(), counted.total()
        time.sleep(seconds)
        result = time.process_time() - before, counted.total() - counted_before
        stop.set()
        thread.join()
    return result


def main() -> int:
    """Measure one backend in this process, or all in processes of their own."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vehicles", type=int, nargs="+", default=[1, 4, 8])
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--only", choices=["mavsdk", "fleet"], help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.only:
        port, count = free_port(), args.vehicles[0]
        sim = [sys.executable, "-m", "gcs_plugin.cli", "sim", "--vehicles", str(count), "--autopilot", "ardupilot"]
        with subprocess.Popen([*sim, "--link", f"udpout:127.0.0.1:{port}"], stdout=subprocess.DEVNULL) as child:
            try:
                run = with_mavsdk if args.only == "mavsdk" else with_fleet
                cpu_s, messages = run(port, count, args.seconds)
            finally:
                child.terminate()
        share = messages / (20.0 * count * args.seconds)
        cpu = cpu_s / args.seconds
        print(f"{args.only:8} {count:4} vehicles {share:6.1%} of 20 messages/s each, {cpu:6.1%} of a core", flush=True)
        return 0
    for count in args.vehicles:
        for only in ("fleet", "mavsdk"):
            command = [sys.executable, "-m", "benchmarks.speed.mavsdk_load", "--only", only, "--vehicles", str(count)]
            subprocess.run([*command, "--seconds", str(args.seconds)], check=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
