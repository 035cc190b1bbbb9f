"""A simulated swarm flight over level ground in value types only: cameras, what was recorded of them, what failed."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from orthoswarm.export.product_files import write_frames, write_json
from orthoswarm.model.camera import Camera, Lens, focal_px, rotation_from_angles
from orthoswarm.model.frame import Fix, Frame, Rejection
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.placement import PlacedFrame

EPSG = 32632
CORNER = np.array([600_000.0, 5_300_000.0])
"""South-west corner of the area, grid metres."""
STEP_M = 12.0
HEIGHT_M = 80.0


@dataclass(kw_only=True)
class FlownArea:
    """Lines of the swarm over a rectangle, 400 x 300 m: lines run north, 50 m apart, and are shared out in turn."""

    width_m: float = 400.0
    height_m: float = 300.0
    spacing_m: float = 50.0
    fov_deg: float = 60.0
    vehicles: int = 2
    dropped: set[tuple[int, int]] = field(default_factory=set)
    """(line, picture) without a picture."""
    skip_numbers: bool = True
    """Missing pictures leave a hole in the numbers of the files."""
    sigma_m: float = 0.2
    recorded_share: float = 1.0
    """Recorded height, as a share of the true one."""

    @property
    def grid(self) -> LocalGrid:
        """The area's grid."""
        return LocalGrid(EPSG)

    def lines(self) -> int:
        """How many lines there are."""
        return int(np.ceil(self.width_m / self.spacing_m))

    def placed(self) -> list[PlacedFrame]:
        """The frames."""
        frames = []
        numbers = dict.fromkeys(range(self.vehicles), 0)
        when = dict.fromkeys(range(self.vehicles), 1.75e9)
        for line in range(self.lines()):
            vehicle = line % self.vehicles
            count = int(self.height_m / STEP_M) + 1
            for k in range(count):
                when[vehicle] += 1.2
                missing = (line, k) in self.dropped
                numbers[vehicle] += 1 if self.skip_numbers or not missing else 0
                if missing:
                    continue
                along = STEP_M * k if (line // self.vehicles) % 2 == 0 else self.height_m - STEP_M * k
                at = CORNER + np.array([self.spacing_m * (line + 0.5), along])
                frames.append(self._frame(f"v{vehicle + 1}", numbers[vehicle], at, when[vehicle]))
            when[vehicle] += 8.0
        return frames

    def _frame(self, vehicle: str, number: int, at: np.ndarray, time_s: float) -> PlacedFrame:
        lens = Lens(1600, 1200, focal_px(np.radians(self.fov_deg), 1600))
        rotation = rotation_from_angles(0.0, -np.pi / 2, 0.0)
        name = f"{vehicle}/DJI_{number:04d}.JPG"
        lat, lon = self.grid.to_geographic(at)
        fix = Fix(float(lat), float(lon), self.recorded_share * HEIGHT_M)
        frame = Frame(image=name, path=Path(name), vehicle=vehicle, time_s=time_s, fix=fix, width=1600, height=1200)
        return PlacedFrame(frame, Camera(np.array([*at, HEIGHT_M]), rotation, lens), "fine", self.sigma_m)

    def write(self, out: Path, rejected: list[Rejection] | None = None) -> Path:
        """A map's folder without rasters."""
        out.mkdir(parents=True, exist_ok=True)
        placed = self.placed()
        write_frames(out, placed, rejected or [], self.grid, 0.0)
        vehicles = [
            {"id": f"v{k + 1}", "fov_deg": self.fov_deg, "fov_sigma_deg": 0.05, "frames": 9}
            for k in range(self.vehicles)
        ]
        write_json(out / "report.json", {"ground_z_m": 0.0, "vehicles": vehicles})
        return out

    def area(self, path: Path, margin_m: float = 0.0) -> Path:
        """The rectangle as GeoJSON, grown by a margin."""
        low, high = CORNER - margin_m, CORNER + np.array([self.width_m, self.height_m]) + margin_m
        corners = [low, [high[0], low[1]], high, [low[0], high[1]], low]
        ring = [[float(lon), float(lat)] for lat, lon in self.grid.to_geographic(np.array(corners))]
        write_json(path, {"type": "Polygon", "coordinates": [ring]})
        return path
