"""Posted poses: the way from a file or a link into the journal and back to a frame."""

import json
from pathlib import Path

from gcs_plugin.daemon.intake.posted_pose import frame_of


def test_a_pose_comes_back_as_it_was_recorded():
    """A file's frame, posted as JSON and read from it again, is the same to the last bit."""
    import random

    from gcs_plugin.daemon.intake.posted_pose import posted_frame
    from telemetry.samples.sample import Sample
    from telemetry.samples.sample import frame_of as recorded_frame

    random.seed(3)
    for _ in range(500):
        sample = Sample(
            time_s=1.7e9, lat_deg=round(random.uniform(-90, 90), 8), lon_deg=round(random.uniform(-180, 180), 8),
            height_m=round(random.uniform(1, 200), 3), yaw_deg=round(random.uniform(-180, 360), 6),
            pitch_deg=round(random.uniform(-120, 0), 6), roll_deg=round(random.uniform(-30, 30), 6),
            flight_yaw_deg=round(random.uniform(0, 360), 2), fov_deg=round(random.uniform(20, 150), 4), sigma_m=1.25,
            height_is_ground=random.random() < 0.5,
        )  # fmt: skip
        place = {"image": "a.jpg", "path": Path("a.jpg"), "vehicle": "v"}
        frame = recorded_frame(sample, **place, width=640, height=480)
        posted = posted_frame(frame, "v", "a.jpg")
        kept = json.loads(json.dumps(posted.values))
        again = frame_of(kept, **place, time_s=frame.time_s, size=(640, 480))
        assert again == frame
        assert kept["yaw_deg"] == sample.yaw_deg and kept["fov_deg"] == sample.fov_deg
