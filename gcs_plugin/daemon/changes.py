"""What changed since the basemap: found after an export, in the background, and shown on the page."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

from gcs_plugin.daemon.jobs.job_queue import RunningJob
from gcs_plugin.daemon.jobs.workspace_products import writable
from gcs_plugin.daemon.settings import Settings
from gcs_plugin.daemon.store.frame_rows import all_frames
from gcs_plugin.daemon.store.journal import Change, Journal, no_change
from gcs_plugin.daemon.store.picture_store import PictureStore
from orthoswarm.change.change_files import FIGURES, change_overlay, figures_in


@dataclass(frozen=True, slots=True)
class ChangeTask:
    """What is compared: a workspace and its basemap; `pictures`: (vehicle, image) -> file."""

    workspace: Path
    basemap: Path
    pictures: Mapping[tuple[str, str], Path]


def find_change(task: ChangeTask) -> dict[str, Any]:
    """Compare the products of a workspace with its basemap; returns the shares."""
    from orthoswarm.change.of_folder import change_of
    from orthoswarm.report.page import put_section

    figures = change_of(
        task.workspace, task.workspace, basemap=task.basemap,
        find=lambda vehicle, image: task.pictures.get((vehicle, image)),
    )  # fmt: skip
    put_section(task.workspace, task.workspace)
    return {key: figures[key] for key in ("changed_share", "not_visible_share", "count", "warnings")}


class GroundChanges:
    """Does the jobs `change`, and answers the page."""

    def __init__(self, settings: Settings, journal: Journal, store: PictureStore) -> None:
        self._settings, self._journal, self._store = settings, journal, store

    def find(self, run: RunningJob) -> Change:
        """The handler of a `change` job."""
        workspace, basemap = self._settings.workspace, self._settings.basemap
        if basemap is None or not (workspace / "orthoimage.tif").exists():
            run.job.detail["note"] = "nothing is refined on a basemap"
            return no_change
        compared = workspace / FIGURES
        if compared.exists() and compared.stat().st_mtime_ns >= (workspace / "orthoimage.tif").stat().st_mtime_ns:
            run.job.detail["note"] = "the last one has everything"
            return no_change
        run.report(0.1, "comparing with the basemap")
        pictures = {
            (writable(row.vehicle), writable(row.image)): self._store.path(row.path)
            for row in all_frames(self._journal)
        }
        run.job.detail |= run.run(find_change, ChangeTask(workspace, basemap, pictures))
        return no_change

    def document(self) -> dict[str, Any]:
        """The figures of the last comparison, with `version` (0: none yet) and the `corners` of its picture."""
        version, figures = self._version(), figures_in(self._settings.workspace)
        if not version or figures is None:
            return {"version": 0, "objects": [], "corners": None}
        return figures | {"version": version, "corners": _overlay(self._settings.workspace, version, 0.5)[1]}

    def picture(self, threshold: float) -> tuple[bytes, int] | None:
        """The overlay from a probability on, PNG, and its version; None if nothing was compared yet."""
        version = self._version()
        return (_overlay(self._settings.workspace, version, threshold)[0], version) if version else None

    def _version(self) -> int:
        path = self._settings.workspace / FIGURES
        return path.stat().st_mtime_ns // 1_000_000 if path.is_file() else 0


@lru_cache(maxsize=8)
def _overlay(workspace: Path, _version: int, threshold: float) -> tuple[bytes, list[list[float]]]:
    """See change_overlay: computed once a version and threshold, for all pages."""
    return change_overlay(workspace, threshold)
