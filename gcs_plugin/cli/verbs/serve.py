"""`orthoswarm serve`: the daemon with its web map."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Final

from gcs_plugin.cli.arguments import add_config

if TYPE_CHECKING:
    from ssl import SSLContext

    from gcs_plugin.daemon.settings import Settings
    from gcs_plugin.web.guard import Access


ADDRESS_FILE: Final = "address"
"""In the workspace: where its daemon was served last."""


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.epilog = (
        "Starts without links, basemap or configuration; an existing workspace is continued.\n"
        "LINK is udpin:HOST:PORT, udpout:HOST:PORT, tcp:HOST:PORT or serial:DEVICE:BAUD.\n"
        "Give --source twice for a vehicle's pictures and its CAN bus (can:socketcan:can0, can:slcan:/dev/ttyACM0,\n"
        "can:udp_multicast:239.74.163.2, or can:mavlink for the bus behind the vehicle's own link).\n\n"
        "example:\n  orthoswarm serve --link udpin:0.0.0.0:14550 --basemap before.tif --workspace flood"
    )
    add = parser.add_argument
    add("--link", action="append", default=[], metavar="URL", help="MAVLink link; give it again for more")
    add("--basemap", type=Path, metavar="MAP", help="pre-disaster map: GeoTIFF, COG, MBTiles or folder z/x/y.png")
    add(
        "--workspace",
        type=Path,
        default=Path("workspace"),
        metavar="DIR",
        help="folder of pictures, maps and settings (default: workspace)",
    )
    add("--port", type=int, metavar="P", help="of HTTP (default 8650; 0 takes any free one)")
    add("--bind", metavar="ADDRESS", help="address of HTTP (default 127.0.0.1; any other needs the token)")
    add("--lan", action="store_true", default=None, help="serve other machines: HTTPS, and people with roles")
    add("--open-reading", action="store_true", default=None, help="with --lan: everybody in the network may look")
    add(
        "--allow-origin", action="append", default=[], metavar="ORIGIN",
        help="pages of this origin (https://maps.example) may read tiles, TileJSON, WMTS and /api/layers",
    )  # fmt: skip
    add("--certificate", type=Path, metavar="FILE", help="with --lan: PEM certificate (default: one is made)")
    add("--key", type=Path, metavar="FILE", help="of that certificate")
    add("--token-file", type=Path, metavar="FILE", help="where the token is, or goes (default: in the workspace)")
    add("--fov-min", type=float, metavar="DEG", help="smallest horizontal field of view in the swarm (default 70)")
    add("--gsd", type=float, metavar="M", help="ground pixel of the map (default: that of the first pictures)")
    add("--dem", type=Path, metavar="FILE", help="height model: plans follow the ground, vehicles get terrain data")
    add("--workers", type=int, metavar="N", help="processes that refine (default: one less than cores)")
    add(
        "--source",
        action="append",
        default=[],
        metavar="ID=WHERE",
        help="pictures of a vehicle (stream or folder), or its CAN bus: can:socketcan:can0, can:mavlink",
    )
    add("--tak", action="append", default=[], metavar="URL", help="send vehicles and finds there: udp://239.2.3.1:6969")
    add_config(parser)
    add("--show-token", action="store_true", help="print the page's link with the workspace's token and end")
    add("--invite", metavar="NAME=ROLE", help="print an invitation of a running daemon's (viewer, analyst, pilot)")
    add(
        "--end-with-input",
        action="store_true",
        help="end when standard input is closed, so together with the program that started it",
    )
    add("--init", action="store_true", help="write a commented orthoswarm.toml into the workspace and end")


def run(args: argparse.Namespace) -> int:
    """Serve until interrupted."""
    from orthoswarm.compute.workers import prepare_process

    prepare_process()
    import sys

    from gcs_plugin.daemon.settings import FILE, TEMPLATE
    from orthoswarm.export.atomic_file import disk_error
    from orthoswarm.model.errors import InputError

    if args.workspace.exists() and not args.workspace.is_dir():
        raise InputError(f"{args.workspace} is a file; choose a folder for --workspace")
    try:
        args.workspace.mkdir(mode=0o700, parents=True, exist_ok=True)
        if args.init:
            path = args.workspace / FILE
            if path.exists():
                raise InputError(f"{path} is there already; edit it")
            path.write_text(TEMPLATE, encoding="utf-8")
            print(path)
            print(f"edit it, then: orthoswarm serve --workspace {args.workspace}", file=sys.stderr)
            return 0
    except OSError as error:
        raise disk_error(error, args.workspace) from None
    settings = settings_of(args)
    if args.invite:
        return _invite(settings, args.invite)
    return _show_token(settings) if args.show_token else serve(settings, end_with_input=args.end_with_input)


def _show_token(settings: "Settings") -> int:
    """Print the page's link with the workspace's token, for a running or future daemon."""
    from gcs_plugin.web.guard import take_token

    token = take_token(_token_file(settings))
    _print_link(_address(settings), token)
    return 0


def _address(settings: "Settings") -> str:
    """Where the workspace's daemon was served last, or will be."""
    import contextlib

    with contextlib.suppress(OSError, UnicodeDecodeError):  # a daemon was started there, perhaps on another port
        return (settings.workspace / ADDRESS_FILE).read_text(encoding="utf-8").strip() or _url(settings, settings.port)
    return _url(settings, settings.port)


def _invite(settings: "Settings", text: str) -> int:
    """Have the running daemon invite somebody, and print the link."""
    from gcs_plugin.mavproxy.daemon_client import Client
    from gcs_plugin.web.guard import take_token
    from orthoswarm.model.errors import OrthoSwarmError

    name, _, role = text.rpartition("=")
    client = Client(_address(settings), take_token(_token_file(settings)), settings.certificate or settings.workspace)
    try:
        _print_qr(client.ask("/api/people", {"name": name, "role": role})["link"], f"{role} {name}")
    except RuntimeError as error:
        raise OrthoSwarmError(str(error)) from None
    return 0


def _print_link(url: str, token: str) -> None:
    print(f"map: {url}#token={token}", flush=True)
    print(f"token: {token}", flush=True)


def _print_qr(link: str, what: str) -> None:
    """Print a link, on a terminal as a QR code, too."""
    import sys

    import segno

    print(f"{what}: {link}", flush=True)
    if sys.stdout.isatty():
        segno.make(link, micro=False).terminal(border=2, compact=True)


def _token_file(settings: "Settings") -> Path:
    return settings.token_file or settings.workspace / "token"


def _url(settings: "Settings", port: int) -> str:
    """The page's address; where all addresses are served, by the first by which others reach this machine."""
    from gcs_plugin.web.certificate import own_addresses

    bind = settings.bind
    if bind in ("0.0.0.0", "::"):
        bind = next(iter(own_addresses()), "127.0.0.1")
    host = f"[{bind}]" if ":" in bind else bind
    return f"http{'s' if settings.lan else ''}://{host}:{port}/"


def settings_of(args: argparse.Namespace) -> "Settings":
    """The settings of the workspace's file, overridden by the flags."""
    from dataclasses import replace

    from gcs_plugin.daemon.intake.can_reader import CAN
    from gcs_plugin.daemon.settings import BIND, VehicleSettings, read_settings
    from orthoswarm.compute.workers import cores
    from orthoswarm.config import read_config
    from orthoswarm.matchers.network_device import require_device
    from orthoswarm.model.errors import InputError

    settings, config = read_settings(args.workspace), read_config(args.config)
    require_device(config.matchers.device)
    flags = {
        "bind": args.bind, "port": args.port, "basemap": args.basemap, "dem": args.dem, "fov_min_deg": args.fov_min,
        "gsd_m": args.gsd, "workers": args.workers, "token_file": args.token_file, "links": tuple(args.link) or None,
        "tak": tuple(args.tak) or None, "config": config, "allow_origins": tuple(args.allow_origin) or None,
        "lan": args.lan, "open_reading": args.open_reading, "certificate": args.certificate, "key": args.key,
    }  # fmt: skip
    if args.workers is None and settings.workers == 1:
        flags["workers"] = max(1, cores() - 1)
    settings = replace(settings, **{key: value for key, value in flags.items() if value is not None})
    if settings.lan and settings.bind == BIND and args.bind is None:
        settings = replace(settings, bind="0.0.0.0")
    vehicles = {vehicle.id: vehicle for vehicle in settings.vehicles}
    for text in args.source:
        name, _, where = text.partition("=")
        if not name or not where:
            raise InputError(f"--source {text} is not of the form ID=WHERE; for example v1=udp://0.0.0.0:5600")
        where_to = {"can": where.removeprefix(CAN)} if where.startswith(CAN) else {"pictures": where}
        vehicles[name] = replace(vehicles.get(name, VehicleSettings(name)), **where_to)
    return replace(settings, vehicles=tuple(vehicles.values())).check()


def serve(settings: "Settings", *, end_with_input: bool = False) -> int:
    """Run daemon and web server until SIGINT or SIGTERM, or (`end_with_input`) until standard input ends.

    A program that starts the daemon and holds the other end of its standard input ends the daemon with itself in any
    case, since the operating system closes that end.
    """
    import logging
    import os
    import sys
    import threading

    import uvicorn

    from gcs_plugin.daemon.daemon import Daemon
    from gcs_plugin.daemon.intake.picture_sources import STREAM_THREAD
    from gcs_plugin.web.app import make_app
    from gcs_plugin.web.connections import (
        ConnectionLimits,
        Connections,
        Server,
        bounded_protocol,
        open_files,
        open_listener,
    )
    from gcs_plugin.web.guard import Access, take_token

    logging.basicConfig(stream=sys.stderr, level=logging.INFO, format="%(levelname)s %(message)s")
    os.umask(0o077)  # pictures, plans and the token are readable by their owner only
    limits = ConnectionLimits.of_files(open_files())
    listener = open_listener(settings.bind, settings.port)
    url = _url(settings, listener.getsockname()[1])
    encryption = _encryption(settings)
    with Daemon(settings) as daemon, listener:
        origins = frozenset(origin.lower() for origin in settings.allow_origins)
        token = take_token(_token_file(settings))
        access = Access(token, settings.bind, settings.lan, settings.open_reading, origins)
        config = uvicorn.Config(
            make_app(daemon, access, url), log_level="warning", access_log=False, server_header=False,
            timeout_graceful_shutdown=3, ws_max_size=1 << 16, lifespan="on", backlog=limits.waiting,
            http=bounded_protocol(Connections(limits)),
        )  # fmt: skip
        config.load()
        config.ssl = encryption
        # a client may connect as soon as it reads the address, and waits until it is served
        listener.listen(config.backlog)
        (settings.workspace / ADDRESS_FILE).write_text(url + "\n", encoding="utf-8")
        _print_link(url, access.token)
        _print_reach(settings, access, url)
        server = Server(config)

        def end(*_: object) -> None:
            """End at a signal, at once at the second, and do not raise it again: the daemon has to be closed, too."""
            server.force_exit, server.should_exit = bool(server.should_exit), True

        server.handle_exit = end
        if end_with_input:
            threading.Thread(target=_when_input_ends, args=(end,), name="input", daemon=True).start()
        server.run(sockets=[listener])
    if any(thread.name.startswith(STREAM_THREAD) for thread in threading.enumerate()):
        logging.shutdown()  # a dead stream blocks its reader inside a library; everything else is closed
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)
    return 0


def _encryption(settings: "Settings") -> "SSLContext | None":
    """The TLS of a command post, None in clear; a certificate of its own is made where none was given."""
    from gcs_plugin.web.certificate import own_names, server_context, take_certificate
    from orthoswarm.export.atomic_file import disk_error

    if not settings.lan:
        return None
    if settings.certificate is not None and settings.key is not None:
        return server_context(settings.certificate, settings.key)
    try:
        own = take_certificate(settings.workspace, own_names())
    except OSError as error:
        raise disk_error(error, settings.workspace) from None
    return server_context(own, own)


def _print_reach(settings: "Settings", access: "Access", url: str) -> None:
    """Print how others reach the daemon, and by what they know that it is this one."""
    import logging

    from gcs_plugin.web.certificate import KEY, fingerprint, spoken

    if settings.lan:
        digits = fingerprint(settings.certificate or settings.workspace / KEY)
        print(f"certificate, SHA-256: {digits}\n  begins with: {spoken(digits)}", flush=True)
        _print_qr(url, "for others")
    elif not access.is_local:
        logging.warning("traffic is not encrypted, whoever shares the network reads the token; use --lan instead")


def _when_input_ends(end: Callable[[], None]) -> None:
    """Call a function once standard input has ended."""
    import os

    while os.read(0, 4096):
        pass
    end()
