"""Simulated cameras: the twin rendered at a vehicle's true pose, streamed as H.264 in MPEG-TS, poses as SEI."""

import contextlib
import queue
import socket
import threading
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, Final, Protocol

import numpy as np

from orthoswarm.model.arrays import Bytes
from orthoswarm.model.camera import Camera, Lens, focal_px, rotation_from_angles
from orthoswarm.twin.drone_photo import Sensor
from orthoswarm.twin.ray_marching import lens_rays, render
from telemetry.samples.sample import Sample

if TYPE_CHECKING:
    from gcs_plugin.sim.mission_flight import TakenPicture
    from orthoswarm.twin.ray_marching import PreparedScene
    from orthoswarm.twin.site import Site


from orthoswarm.twin.flights import FlightPlan
from orthoswarm.twin.presets import TwinSpec, spec
from orthoswarm.twin.site import Site

_POSITION_M: Final = 0.8
_JITTER_RAD: Final = float(np.radians(0.2))
_CLOCK: Final = 90_000  # ticks a second of a video's time stamps
_MOST_WAITING: Final = 512  # pictures
_NEXT: Final = b"\0\0\0\1\x09\xf0"
"""Access unit delimiter of the next picture, sent after each picture: the reader knows at once that it is complete."""


HEIGHT_M: Final = 90.0
FOV_MIN_DEG: Final = 75.0
_FOVS_DEG: Final = (85.0, 90.0, 95.0, 100.0)
_ALONG_M: Final = 290.0
_ACROSS_M: Final = 120.0
_STEP_M: Final = 5.0
_MARGIN_M: Final = 180.0
WIDTH, HEIGHT = 640, 480


@dataclass(frozen=True, slots=True)
class DemoSetting:
    """The demonstration's parameters.

    Attributes:
        vehicles: how many. seed: of city, disaster and errors. speed: simulated seconds per real second, at most.
    """

    vehicles: int = 3
    seed: int = 1
    speed: float = 6.0

    @property
    def twin(self) -> TwinSpec:
        """Parameters of the twin; the disaster covers about a tenth of the area, in its middle."""
        across, along = (0.4 * side for side in self.extent_m)
        plan = FlightPlan(
            columns=1, legs=2, photos=round((2.0 * along + 0.5 * across) / _STEP_M) + 1, spacing_m=_STEP_M,
            leg_spacing_m=0.5 * across, height_m=HEIGHT_M, width=WIDTH, height=HEIGHT,
        )  # fmt: skip
        return spec("debris", seed=self.seed, plan=plan, margin_m=_MARGIN_M + 0.3 * max(self.extent_m))

    @property
    def extent_m(self) -> tuple[float, float]:
        """Size of the area to map, east and north: two legs for each vehicle."""
        return _ACROSS_M * self.vehicles, _ALONG_M

    def area(self) -> dict[str, Any]:
        """The area to map, a GeoJSON polygon."""
        site = Site.of(self.twin)
        half = 0.5 * np.array(self.extent_m)
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * half + np.array(site.center)
        ring = [[float(lon), float(lat)] for lat, lon in site.grid.to_geographic(corners)]
        return {"type": "Polygon", "coordinates": [ring]}

    def home(self) -> tuple[float, float, float]:
        """Latitude, longitude (degrees) and altitude (metres) of the first vehicle, at the area's south-west corner."""
        site = Site.of(self.twin)
        east, north = (c - 0.5 * side for c, side in zip(site.center, self.extent_m, strict=True))
        lat, lon = (float(v) for v in site.grid.to_geographic([east, north]))
        return lat, lon, 500.0


@dataclass(frozen=True, slots=True)
class Errors:
    """Constant errors of one vehicle's recorded poses, and its true field of view; radians."""

    fov_rad: float
    yaw_rad: float
    pitch_rad: float
    roll_rad: float

    @classmethod
    def of(cls, setting: DemoSetting, system: int) -> "Errors":
        """The errors of a vehicle, constant during its flight."""
        rng = np.random.default_rng([setting.seed, 211, system])
        yaw, pitch, roll = np.radians(rng.normal(0.0, [2.0, 0.8, 0.8]))
        return cls(float(np.radians(rng.choice(_FOVS_DEG))), float(yaw), float(pitch), float(roll))


class TwinCamera:
    """The camera of one vehicle in the twin.

    Args:
        stage: the city. site: its position.
        setting: of the demonstration.
        system: the vehicle's MAVLink system id.
        rays: along the side of a pixel; 2 gives smooth edges, 1 is four times faster.
    """

    def __init__(self, stage: "PreparedScene", site: "Site", setting: DemoSetting, system: int, rays: int = 2) -> None:
        self._stage, self._site, self._system = stage, site, system
        self._errors = Errors.of(setting, system)
        self._lens = Lens(WIDTH, HEIGHT, focal_px(self._errors.fov_rad, WIDTH))
        self._rays = lens_rays(self._lens, rays)
        self._sensor = Sensor(WIDTH, HEIGHT, setting.seed)
        self._seed = setting.seed

    def take(self, exposure: "TakenPicture", time_s: float) -> tuple[Bytes, Sample]:
        """The picture, uint8 (480, 640, 3), and its recorded pose; a gimbal keeps the camera at nadir."""
        pose = exposure.pose
        true = Sample(
            time_s=time_s, lat_deg=pose.lat_deg, lon_deg=pose.lon_deg, height_m=pose.height_m,
            yaw_deg=float(np.degrees(pose.yaw_rad)), pitch_deg=-90.0, roll_deg=0.0,
        )  # fmt: skip
        return self.shoot(true, exposure.index, received=(exposure.lat_deg, exposure.lon_deg))

    def shoot(self, true: Sample, index: int, *, received: tuple[float, float] | None = None) -> tuple[Bytes, Sample]:
        """The picture at a pose, uint8 (480, 640, 3), and its recorded pose.

        Args:
            true: true position, height, angles and time of the camera.
            index: number of the picture; equal arguments give equal pictures.
            received: latitude and longitude of the GNSS receiver without its noise, degrees; None: the true ones.
        """
        errors, grid = self._errors, self._site.grid
        lat, lon, height, time_s = (float(v or 0.0) for v in (true.lat_deg, true.lon_deg, true.height_m, true.time_s))
        yaw, pitch, roll = np.radians([true.yaw_deg or 0.0, true.pitch_deg or 0.0, true.roll_deg or 0.0])
        rng = np.random.default_rng([self._seed, 223, self._system, index, round(time_s)])
        east, north = grid.to_grid(lat, lon)
        turn = float(grid.convergence_rad(lat, lon))
        wobble = rng.normal(0.0, _JITTER_RAD, 3)
        # constant misalignment of the mount, which is not in the recorded pose
        angles = np.array([yaw + errors.yaw_rad - turn, pitch + errors.pitch_rad, roll + errors.roll_rad]) + wobble
        camera = Camera(np.array([east, north, height]), rotation_from_angles(*angles), self._lens)
        motion = rng.uniform(0.0, 1024.0, 8)
        image = self._sensor.expose(render(self._stage, camera, self._rays, motion), rng)
        off = rng.uniform(-_POSITION_M, _POSITION_M, 2)
        lat, lon = (float(v) for v in grid.to_geographic(grid.to_grid(*(received or (lat, lon))) + off))
        return image, replace(true, lat_deg=lat, lon_deg=lon, vehicle=f"v{self._system}")


class Sink(Protocol):
    """A writable byte stream, like a file."""

    def write(self, data: bytes) -> int:
        """Write bytes; returns their number."""


class VideoStream:
    """Encodes pictures to H.264 in MPEG-TS, every picture a key picture with its pose as SEI.

    Args:
        sink: receives the stream's bytes; each write is a multiple of 188 bytes, the size of a transport packet.
    """

    def __init__(self, sink: Sink) -> None:
        self._sink = sink
        self._container: Any = None
        self._stream: Any = None
        self._form: Any = None
        self._first_s = 0.0

    def send(self, image: Bytes, sample: Sample) -> None:
        """Encode and send a picture, uint8 (rows, columns, 3)."""
        import av

        from telemetry.formats.video.bitstream import StreamFormat
        from telemetry.write.sei_writer import with_sei

        time_s = float(sample.time_s or 0.0)
        if self._container is None:
            self._open(time_s)
        frame = av.VideoFrame.from_ndarray(image, format="rgb24").reformat(format="yuv420p")
        frame.pts = round((time_s - self._first_s) * _CLOCK)
        for packet in self._stream.encode(frame):
            if self._form is None:
                self._form = StreamFormat.of("h264", self._stream.codec_context.extradata)
            marked = av.Packet(with_sei(bytes(packet), sample, self._form) + _NEXT)
            marked.pts, marked.dts, marked.time_base = packet.pts, packet.dts, packet.time_base
            marked.is_keyframe, marked.stream = packet.is_keyframe, self._stream
            self._container.mux(marked)

    def close(self) -> None:
        """End the stream."""
        if self._container is not None:
            with contextlib.suppress(OSError):
                self._container.close()

    def _open(self, time_s: float) -> None:
        from fractions import Fraction

        import av

        self._first_s = time_s
        # a PES packet with a stated length is complete for the reader at once, not only when the next one begins
        options = {"omit_video_pes_length": "0", "flush_packets": "1"}
        self._container = av.open(self._sink, "w", format="mpegts", options=options)
        stream = self._container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.codec_context.time_base = Fraction(1, _CLOCK)
        # constant quality, and never more than a PES packet with a stated length can hold
        x264 = "keyint=1:vbv-maxrate=4000:vbv-bufsize=400:bframes=0"
        stream.options = {"preset": "veryfast", "tune": "zerolatency", "crf": "17", "x264-params": x264}
        self._stream = stream


class VideoServer(VideoStream):
    """Serves one live stream over TCP.

    Args:
        host: address to serve on; port: 0 for any free one.
        live: True buffers about the newest hundred pictures for a reader who connects at any later time; False buffers
            all pictures, and gives up without a reader for half a minute.

    Attributes:
        url: address of the stream.

    Raises:
        OSError: the port is in use.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 0, *, live: bool = False) -> None:
        super().__init__(self)
        self._live = live
        self._listener = socket.create_server((host, port))
        self.url = f"tcp://{host}:{self._listener.getsockname()[1]}"
        self._bytes: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._serve, name="video", daemon=True)
        self._thread.start()

    def write(self, data: bytes) -> int:
        """Queue bytes of the muxer, which writes to this object as to a file."""
        if self._live and self._bytes.qsize() >= _MOST_WAITING:
            with contextlib.suppress(queue.Empty):
                self._bytes.get_nowait()
        self._bytes.put(bytes(data))
        return len(data)

    def close(self) -> None:
        """End the stream."""
        super().close()
        self._bytes.put(None)
        self._thread.join(5.0)
        self._listener.close()

    def _serve(self) -> None:
        connection: socket.socket | None = None
        while True:
            data = self._bytes.get()
            if data is None:
                break
            while connection is None or not _sent(connection, data):
                if connection is not None:  # its reader has gone
                    connection.close()
                    connection = None
                try:
                    self._listener.settimeout(30.0)
                    connection = self._newest()
                except TimeoutError:
                    if not self._live:  # nobody watches any more
                        return
                except OSError:  # closed
                    return
        if connection is not None:
            connection.close()

    def _newest(self) -> socket.socket:
        """The most recent connection: a reader that timed out has connected again."""
        connection, _ = self._listener.accept()
        self._listener.settimeout(0.2)
        with contextlib.suppress(TimeoutError):
            while True:
                newer, _ = self._listener.accept()
                connection.close()
                connection = newer
        return connection


def _sent(connection: socket.socket, data: bytes) -> bool:
    """Send; False if the reader has closed the connection, since sending would then succeed without an error."""
    try:
        connection.settimeout(0.0)
        try:
            if connection.recv(1) == b"":
                return False
        except BlockingIOError:
            pass
        connection.settimeout(30.0)
        connection.sendall(data)
    except OSError:
        return False
    return True


class VideoSender(VideoStream):
    """Sends one live stream by UDP; without a receiver the datagrams are lost.

    Args:
        host: destination address; port: destination port.
    """

    _DATAGRAM: Final = 7 * 188  # transport packets that fit into an Ethernet frame

    def __init__(self, host: str, port: int) -> None:
        super().__init__(self)
        self.url = f"udp://{host}:{port}"
        self._to = (host, port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)

    def write(self, data: bytes) -> int:
        """Send bytes of the muxer."""
        for at in range(0, len(data), self._DATAGRAM):
            with contextlib.suppress(OSError):
                self._socket.sendto(data[at : at + self._DATAGRAM], self._to)
        return len(data)

    def close(self) -> None:
        """End the stream."""
        super().close()
        self._socket.close()


@dataclass(slots=True, kw_only=True)
class RenderQueue:
    """Renders and streams the pictures of all vehicles in one thread, in the order of their exposures.

    Attributes:
        cameras, servers: by system id. taken: number of pictures so far. problem: the last error, empty without one.
    """

    cameras: dict[int, TwinCamera]
    servers: dict[int, VideoServer]
    taken: int = 0
    problem: str = ""
    _waiting: "queue.SimpleQueue[tuple[int, TakenPicture, float] | None]" = field(default_factory=queue.SimpleQueue)
    _thread: threading.Thread = field(init=False)

    def __post_init__(self) -> None:
        """Start the thread."""
        self._thread = threading.Thread(target=self._run, name="render-queue", daemon=True)
        self._thread.start()

    @property
    def backlog(self) -> int:
        """Number of pictures waiting to be rendered."""
        return self._waiting.qsize()

    def expose(self, vehicle: Any, exposure: "TakenPicture") -> None:
        """Queue a picture (SimVehicle.on_exposure)."""
        self._waiting.put((vehicle.system, exposure, vehicle.utc_s(exposure.time_s)))

    def close(self) -> None:
        """Render the waiting pictures and end the streams."""
        self._waiting.put(None)
        self._thread.join(60.0)
        for server in self.servers.values():
            server.close()

    def _run(self) -> None:
        while True:
            request = self._waiting.get()
            if request is None:
                return
            system, exposure, time_s = request
            try:
                self.servers[system].send(*self.cameras[system].take(exposure, time_s))
                self.taken += 1
            except Exception as error:  # reported at the end; the flight goes on
                self.problem = f"{type(error).__name__}: {error}"
