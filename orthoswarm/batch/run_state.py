"""The options, context and state of a run."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from orthoswarm.batch.refiners import RefinerName
from orthoswarm.batch.workspace import Workspace
from orthoswarm.compute.stage_times import Clock
from orthoswarm.compute.workers import Workers
from orthoswarm.config import DEFAULT, Config
from orthoswarm.control.ground_control import GroundControl
from orthoswarm.evaluation.checkpoints import Checkpoint
from orthoswarm.export.catalog.tiled_raster import FOLDER, Tiles, is_tile_or_collection
from orthoswarm.export.temperature import TEMPERATURE
from orthoswarm.export.value_raster import GROUND
from orthoswarm.model.arrays import Bytes, Floats
from orthoswarm.model.frame import Ingest, Rejection
from orthoswarm.model.geo import LocalGrid
from orthoswarm.model.placement import PlacedFrame, Terrain
from orthoswarm.model.task_runner import Progress
from orthoswarm.mosaic.recorded_pose import Recorded
from orthoswarm.mosaic.render_passes import Read
from orthoswarm.mosaic.renderer import NOTHING_DRAWN, Blend, DrawnGround
from orthoswarm.mosaic.seams.previews import PreviewFile
from orthoswarm.raster.basemap import Basemap
from orthoswarm.raster.grey_pictures import GreyPictures
from orthoswarm.raster.height_model import HeightModel
from orthoswarm.raster.picture_file import read_rgb
from orthoswarm.raster.picture_parts import PictureParts
from orthoswarm.refine.registration.map_offset import MapOffset

Load = Callable[[Progress], Ingest]

REALTIME, COARSE, ORTHOIMAGE = "realtime.tif", "coarse.tif", "orthoimage.tif"
SEAMLINES, CONFIDENCE = "seamlines.gpkg", "confidence.tif"
PRODUCTS = (
    REALTIME,
    COARSE,
    ORTHOIMAGE,
    "frames.jsonl",
    "footprints.gpkg",
    SEAMLINES,
    CONFIDENCE,
    GROUND,
    "report.json",
    "report.html",
)


UNREFERENCED = "unreferenced.tif"

WRITTEN = (
    *PRODUCTS,
    UNREFERENCED,
    TEMPERATURE,
    *(name.replace(".tif", ".vrt") for name in (REALTIME, COARSE, ORTHOIMAGE)),
    FOLDER,
)
"""Files and folders that runs write, those of rasters in tiles among them."""


def is_written(name: str) -> bool:
    """Whether runs write a file of this name (path in the output folder)."""
    return name in WRITTEN or is_tile_or_collection(name)


@dataclass(frozen=True, slots=True, kw_only=True)
class MapOptions:
    """The options of a run.

    Attributes:
        basemap: the pre-disaster map, None to stay in the receivers' frame.
        near: latitude and longitude, degrees, and a radius, metres, within which photos without a position are looked
            for on the basemap; None: they are not.
        unreferenced: of photos without any position make a picture without coordinates, see batch.unreferenced.
        refine: which refiner. until: the last stage to run.
        fov_min_deg: theta-hat, the assumed field of view of the real-time stage; None takes hints, else 70.
        gsd_m: ground pixel of the products; None for the median ground pixel at nadir.
        surface: where to write a surface model; None for none.
        dem: raster of ground heights. split_legs: treat each leg of a vehicle as a separate vehicle.
        gains: balance brightness between pictures. tone: where brightness and hue of large areas come from, used with
            gains and a basemap on which pictures were found.
        blend: mix the two pictures at each seam, see Seams. edge: of the orthoimage, all that was seen, or trimmed to
            what several pictures see.
        control: surveyed points that move the map onto the ground; checkpoints: others that it is measured at (files
            as of evaluation.checkpoints). pixel_scale: pixels of the photos to one of those in which they were marked.
        temperature: write `temperature.tif`, of thermal pictures, see export.temperature; kelvin of a count of 16
            bits, 0 for pictures of 32.
        covariance: write the covariance of each camera's position and rotation to frames.jsonl.
        tiles: write rasters in tiles with a STAC collection: "yes", "no", or "auto" by their pixels.
        quick: draw refined maps at a quarter of the detail, and keep what a run without it goes on from.
        config: the settings of the stages.
    """

    basemap: Path | None = None
    near: tuple[float, float, float] | None = None
    unreferenced: bool = False
    refine: RefinerName = "swarm"
    until: Literal["realtime", "coarse", "fine"] = "fine"
    fov_min_deg: float | None = None
    gsd_m: float | None = None
    surface: Path | None = None
    dem: Path | None = None
    split_legs: bool = False
    gains: bool = True
    tone: Literal["photos", "map"] = "photos"
    blend: Blend = "seam"
    edge: Literal["all", "trim"] = "all"
    control: Path | None = None
    checkpoints: Path | None = None
    pixel_scale: float = 1.0
    temperature: float | None = None
    covariance: bool = False
    tiles: Tiles = "auto"
    quick: bool = field(default=False, repr=False)  # no part of a run's key: the other run is the same one
    config: Config = DEFAULT


@dataclass(slots=True, kw_only=True)
class RunContext:
    """The environment of a run's stages.

    Attributes:
        out: output folder; space: its lock and results of an interrupted run.
        options: see MapOptions. workers: run the tasks. progress: called during long work. clock: times by stage.
        drawers: run the tasks that write into the output folder; the same workers where these see it.
    """

    out: Path
    space: Workspace
    options: MapOptions
    workers: Workers
    drawers: Workers
    progress: Progress
    clock: Clock


@dataclass(slots=True, kw_only=True)
class RunState:
    """The results of a run so far.

    Attributes:
        ingest: the frames as read. grid: the area's. recorded: cameras as recorded. gsd_m: pixel of the products.
        basemap: the map; None without one, or once it proved unreadable. dem: heights for the refiner.
        warnings: for the report. rejected: image -> why it was left out.
        thumbnails, gains: image -> small picture, brightness gains.
        still: frames of vehicles that hovered. odd: frames of another camera or direction than their vehicle's others.
        terrain: ground under the fine cameras. drawn: what the map covers. trust: how far, see mosaic.confidence.
        previews: small copies of the pictures, for the seams. pictures: those that are decoded, None to read the files.
        parts: what the real-time map shows of each picture, for the refined ones.
        undrawn: image -> why the real-time picture does not show it.
        control_offset: offset between control points and receivers, None without control points.
        control_points: surveyed points to move the map onto. control: their result, None before or without them.
        map_offset: offset between map and receivers, None without a map.
        fault: error inside the refiner, None without one.
    """

    ingest: Ingest
    grid: LocalGrid
    recorded: Recorded
    gsd_m: float
    basemap: Basemap | None
    dem: HeightModel | None = None
    warnings: list[str] = field(default_factory=list)
    rejected: dict[str, Rejection] = field(default_factory=dict)
    thumbnails: dict[str, Bytes] = field(default_factory=dict)
    gains: dict[str, Floats] = field(default_factory=dict)
    still: list[PlacedFrame] = field(default_factory=list)
    odd: list[PlacedFrame] = field(default_factory=list)
    terrain: Terrain | None = None
    drawn: DrawnGround = NOTHING_DRAWN
    trust: Mapping[str, Any] = field(default_factory=dict)
    previews: PreviewFile | None = None
    parts: PictureParts | None = None
    pictures: GreyPictures | None = None
    undrawn: Mapping[str, str] = field(default_factory=dict)
    control_points: list[Checkpoint] = field(default_factory=list)
    control: GroundControl | None = None
    map_offset: MapOffset | None = None
    control_offset: MapOffset | None = None
    fault: str | None = None

    def read_rgb(self) -> Read:
        """Reads a picture's colours for drawing."""
        return read_rgb if self.pictures is None else self.pictures.rgb

    def leave_out(self, reasons: Mapping[str, str], placed: Iterable[PlacedFrame]) -> None:
        """Move frames to the rejected ones."""
        frames = {p.frame.image: p.frame for p in placed} if reasons else {}
        for image, reason in reasons.items():
            frame = frames.get(image)
            vehicle, time_s = (frame.vehicle, frame.time_s) if frame else ("", None)
            self.rejected.setdefault(image, Rejection(image, reason, vehicle, time_s))
