"""The daemon's settings: from flags, and from `orthoswarm.toml` in its workspace."""

import re
import tomllib
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from gcs_plugin.daemon.intake.can_reader import check_bus
from gcs_plugin.daemon.vehicle_names import system_in_name
from gcs_plugin.fleet.separation.separation_watch import VehicleNames
from orthoswarm.config import DEFAULT, Config
from orthoswarm.export.tactical.cursor_on_target import TakAddress
from orthoswarm.model.errors import InputError

FILE: Final = "orthoswarm.toml"
PORT: Final = 8650
BIND: Final = "127.0.0.1"
NO_IDS: Final = frozenset({"all", ".", ".."})
"""Ids that the address of a command cannot have: `all` means every vehicle, and browsers leave out the others."""

TEMPLATE: Final = """\
# What `orthoswarm serve` in this folder does. Flags on the command line win over this file.

# port = 8650
# bind = "127.0.0.1"              # another address needs the token for everything
# lan = true                      # HTTPS for other machines, and people with roles
# open_reading = true             # with lan: everybody in the network may look
# allow_origins = ["https://maps.example"]  # pages of other sites that may read the map's tiles
# certificate = "post.pem"        # with lan: instead of the daemon's own; chain and key in PEM
# key = "post-key.pem"
# basemap = "before.tif"          # GeoTIFF, COG, MBTiles or folder z/x/y.png; relative to this file
# dem = "heights.tif"             # height model: plans follow the ground, and vehicles get their terrain data from it
# links = ["udpin:0.0.0.0:14550", "serial:/dev/ttyUSB0:57600"]
# fov_min_deg = 70                # smallest horizontal field of view in the swarm, for the real-time map
# gsd_m = 0.1                     # ground pixel of the map; from the first pictures unless given
# workers = 1                     # processes that refine
# coarse = true                   # place legs on the coarse layer as they finish, in one more process of low priority
# lost_after_s = 120              # a vehicle that is silent for so long in its mission is refined as it is
# tak = ["udp://239.2.3.1:6969"]  # where vehicles and finds are sent to as Cursor-on-Target: udp, tcp or tls
# picture_folder = "/DCIM"         # where vehicles have their pictures, for those asked for over MAVLink FTP
# picture_bytes_s = 30000         # most that these take of all links together; 0: none is asked for
# tak_certificate = "station.pem" # for tls: certificate and key of this station
# tak_authority = "ca.pem"        # for tls: the server's certificate authority

# [[vehicle]]
# id = "v1"                       # v and the MAVLink system id, unless system says otherwise
# system = 1
# name = "Falcon"
# pictures = "udp://0.0.0.0:5600" # a live stream (rtsp, udp, tcp), or a folder into which photos or videos arrive
# can = "socketcan:can0"          # DroneCAN bus; "mavlink" for the vehicle's own one through its link
"""


@dataclass(frozen=True, slots=True)
class VehicleSettings:
    """One configured vehicle.

    Attributes:
        id: in files and on the map. system: MAVLink system id, None without a link.
        name: shown to people. pictures: stream or folder, empty for none.
        can: CAN bus with DroneCAN ("socketcan:can0", "mavlink"), empty for none.
    """

    id: str
    system: int | None = None
    name: str = ""
    pictures: str = ""
    can: str = ""


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """The daemon's settings.

    Attributes:
        workspace: its folder. bind, port: where HTTP is served (port 0: any free one).
        lan: HTTPS, and people with roles. open_reading: with it, everybody may read.
        allow_origins: of pages of other sites that may read tiles.
        certificate, key: PEM files for it, None for the daemon's own.
        links: MAVLink links. basemap: the map before the disaster, or None. dem: height model of the ground, or None.
        fov_min_deg: theta-hat. gsd_m: ground pixel, from the first pictures if None.
        workers: processes that refine. coarse: True to place legs in flight.
        lost_after_s: silence after which a vehicle's sortie counts as finished.
        silent_s: a vehicle without a new picture for so long is silent; then its legs and late pictures are placed.
        redraw_px: a joint refinement that moves pictures by less, in pixels of the layer, is not drawn.
        vehicles: the configured ones. token_file: path of the token.
        picture_folder: folder of the pictures on the vehicles. picture_bytes_s: most bytes a second that pictures take
            that are asked for over MAVLink FTP, 0 for none.
        tak: receivers of Cursor-on-Target events, see `tak_address`. tak_certificate: PEM file with this station's
            certificate and key for TLS. tak_authority: PEM file of the server's certificate authority.
        config: the settings of the stages (`--config`).
    """

    workspace: Path
    bind: str = BIND
    port: int = PORT
    lan: bool = False
    open_reading: bool = False
    allow_origins: tuple[str, ...] = ()
    certificate: Path | None = None
    key: Path | None = None
    links: tuple[str, ...] = ()
    basemap: Path | None = None
    dem: Path | None = None
    fov_min_deg: float | None = None
    gsd_m: float | None = None
    workers: int = 1
    coarse: bool = True
    lost_after_s: float = 120.0
    silent_s: float = 8.0
    redraw_px: float = 0.1
    vehicles: tuple[VehicleSettings, ...] = field(default=())
    token_file: Path | None = None
    picture_folder: str = "/DCIM"
    picture_bytes_s: float = 30_000.0
    tak: tuple[str, ...] = ()
    tak_certificate: Path | None = None
    tak_authority: Path | None = None
    config: Config = DEFAULT

    def names(self) -> VehicleNames:
        """The vehicles' names."""
        systems = {v.system: v.id for v in self.vehicles if v.system is not None}
        return VehicleNames(systems, {v.id: v.name for v in self.vehicles})

    def systems(self) -> dict[str, int]:
        """The MAVLink system ids of the configured vehicles, by id; of those that have one."""
        known = {v.id: v.system or system_in_name(v.id) for v in self.vehicles}
        return {vehicle: system for vehicle, system in known.items() if system is not None}

    def tak_address(self, text: str) -> TakAddress:
        """A receiver of Cursor-on-Target events; raises InputError: it is not an address."""
        return TakAddress.parse(text, self.tak_certificate, self.tak_authority)

    def check(self) -> "Settings":
        """Check the values; returns itself; raises InputError: a value is invalid."""
        if not 0 <= self.port <= 65535:
            raise InputError(f"port {self.port} is not a port; give 1 to 65535, or 0 for any free one")
        if (self.certificate is None) != (self.key is None):
            raise InputError("a certificate needs its key, and a key its certificate; give both, or none for one's own")
        if not self.lan and (self.open_reading or self.certificate is not None):
            raise InputError("open reading and a certificate are for other machines; give --lan as well")
        for origin in self.allow_origins:
            if not re.fullmatch(r"https?://[^/\s?#@*]+", origin):
                raise InputError(f"'{origin}' is no origin; give scheme and host, for example https://maps.example")
        if self.basemap is not None and not self.basemap.exists():
            raise InputError(f"the basemap {self.basemap} does not exist; check the path")
        if self.dem is not None and not self.dem.is_file():
            raise InputError(f"the height model {self.dem} does not exist; check the path")
        if self.fov_min_deg is not None and not 5.0 <= self.fov_min_deg <= 150.0:
            raise InputError(f"a field of view of {self.fov_min_deg:g} degrees is not possible; for example 70")
        if self.gsd_m is not None and not 0.005 <= self.gsd_m <= 5.0:
            raise InputError(f"{self.gsd_m:g} m is not a ground pixel; give metres, for example 0.1")
        if self.workers < 1:
            raise InputError(f"{self.workers} workers are too few; give 1 or more")
        for text in self.tak:
            self.tak_address(text)
        for path in (self.tak_certificate, self.tak_authority):
            if path is not None and not path.is_file():
                raise InputError(f"{path} does not exist; name the PEM file")
        if not 0.0 <= self.picture_bytes_s <= 1e9:
            raise InputError(f"picture_bytes_s of {self.picture_bytes_s:g} is not possible; give bytes a second, or 0")
        names = [v.id for v in self.vehicles]
        systems = [v.system for v in self.vehicles if v.system is not None]
        for what, values in (("id", names), ("system id", systems)):
            if len(set(values)) != len(values):
                raise InputError(f"two vehicles in {FILE} have the same {what}; give each its own")
        for vehicle in self.vehicles:
            if vehicle.id in NO_IDS:
                raise InputError(f"a vehicle cannot have the id '{vehicle.id}'; give it another, for example v1")
            if vehicle.can:
                check_bus(vehicle.can)
        return self


_KINDS: Final[dict[str, tuple[type, ...]]] = {
    "bind": (str,), "port": (int,), "lan": (bool,), "open_reading": (bool,), "allow_origins": (list,),
    "certificate": (str,), "key": (str,),
    "links": (list,), "basemap": (str,), "dem": (str,), "fov_min_deg": (int, float),
    "gsd_m": (int, float), "workers": (int,), "coarse": (bool,), "lost_after_s": (int, float), "vehicle": (list,),
    "picture_folder": (str,), "picture_bytes_s": (int, float),
    "tak": (list,), "tak_certificate": (str,), "tak_authority": (str,),
}  # fmt: skip


def read_settings(workspace: Path) -> Settings:
    """The settings in a workspace's file; the defaults where there is none.

    Raises:
        InputError: the file cannot be read or says something unknown.
    """
    path = workspace / FILE
    if not path.exists():
        return Settings(workspace=workspace)
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise InputError(f"{path} cannot be read ({error}); correct it") from None
    for key, value in document.items():
        if key not in _KINDS:
            raise InputError(f"{path} says '{key}', which is unknown; choose from: {', '.join(_KINDS)}")
        if not isinstance(value, _KINDS[key]) or (isinstance(value, bool) and bool not in _KINDS[key]):
            raise InputError(f"{key} in {path} is of the wrong kind; see `orthoswarm serve --init`")
    vehicles = tuple(_vehicle(entry, path) for entry in document.pop("vehicle", ()))
    if "links" in document:
        document["links"] = tuple(str(link) for link in document["links"])
    for key in ("tak", "allow_origins"):
        if key in document:
            document[key] = tuple(str(address) for address in document[key])
    for key in ("basemap", "dem", "tak_certificate", "tak_authority", "certificate", "key"):
        if key in document:
            document[key] = workspace / document[key]
    return replace(Settings(workspace=workspace), vehicles=vehicles, **document)


def _vehicle(entry: Any, path: Path) -> VehicleSettings:
    if not isinstance(entry, dict) or not isinstance(entry.get("id"), str) or not entry["id"]:
        raise InputError(f'a [[vehicle]] in {path} has no id; give it one, for example id = "v1"')
    unknown = set(entry) - {"id", "system", "name", "pictures", "can"}
    if unknown:
        raise InputError(f"a [[vehicle]] in {path} says '{unknown.pop()}'; it has id, system, name, pictures and can")
    system = entry.get("system", system_in_name(entry["id"]))
    if system is not None and (isinstance(system, bool) or not isinstance(system, int) or not 1 <= system <= 255):
        raise InputError(f"the system id of {entry['id']} in {path} is not 1 to 255; correct it")
    texts = (str(entry.get(key, "")) for key in ("name", "pictures", "can"))
    return VehicleSettings(entry["id"], system, *texts)
