"""When a vehicle is looked for on the basemap, and which pictures its registration takes."""

from itertools import pairwise
from pathlib import Path

from gcs_plugin.daemon.layers.draw_queue import PendingFrame
from gcs_plugin.daemon.layers.layers import MapArea
from gcs_plugin.daemon.layers.live_registration import MOST_LOOKED_FOR, LiveRegistration
from gcs_plugin.daemon.store.daemon_events import Events, FirstPicturesCame, VehicleLookedFor
from orthoswarm.model.frame import Fix, Frame

AREA = MapArea.around(32631, 500_000.0, 5_000_000.0, 0.3)


def pending(seq):
    frame = Frame(
        image=f"{seq}.jpg", path=Path(f"{seq}.jpg"), vehicle="v1", time_s=1e9 + seq, fix=Fix(45.0, 3.0, 60.0),
        width=160, height=120,
    )  # fmt: skip
    return PendingFrame(seq, 1e9 + seq, 1, frame)


def test_a_vehicle_that_is_not_found_is_looked_for_again_however_many_pictures_came():
    asked, events = [], Events()
    registration = LiveRegistration(Path("map.tif"), events, lambda path: None, lambda whose: 0)
    events.on(FirstPicturesCame, lambda event: asked.append((event.vehicle, event.sortie)))
    counts = []
    for seq in range(1, 6 * MOST_LOOKED_FOR):
        before = len(asked)
        assert registration.place(pending(seq), None, 0) is None
        if len(asked) > before:
            counts.append(seq)
            registration.vehicle_looked_for(VehicleLookedFor("v1", 1, AREA.epsg, None))
            assert list(registration.found(AREA)) == []
    assert set(asked) == {("v1", 1)}
    assert counts[0] == 20
    assert counts[-1] > 4 * MOST_LOOKED_FOR
    assert all(1.3 < later / earlier < 1.6 for earlier, later in pairwise(counts))
