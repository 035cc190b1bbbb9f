"""OrthoSwarm's mapping core: from frames with rough poses to a georeferenced orthoimage.

Arrays and value types in and out; no sockets, no web, no clock. `__all__` is what other programs may use, with that of
`telemetry` and `gcs_plugin` (docs/api.md); other names may change.
"""

from typing import TYPE_CHECKING

from orthoswarm.model.lazy_names import on_first_use

if TYPE_CHECKING:
    from orthoswarm.batch.pipeline import make_map
    from orthoswarm.batch.run_state import MapOptions
    from orthoswarm.evaluation.checkpoints import evaluate_checkpoints
    from orthoswarm.evaluation.orthoimage import evaluate_ortho
    from orthoswarm.model.errors import InputError, OrthoSwarmError
    from orthoswarm.model.frame import Fix, Frame, Ingest, Rejection
    from orthoswarm.model.plan import Plan
    from orthoswarm.model.task_runner import Progress

__version__ = "0.1.0"
__all__ = [
    "Fix",
    "Frame",
    "Ingest",
    "InputError",
    "MapOptions",
    "OrthoSwarmError",
    "Plan",
    "Progress",
    "Rejection",
    "evaluate_checkpoints",
    "evaluate_ortho",
    "make_map",
]

__getattr__ = on_first_use(
    __name__,
    {
        "batch.pipeline": ("make_map",),
        "batch.run_state": ("MapOptions",),
        "evaluation.checkpoints": ("evaluate_checkpoints",),
        "evaluation.orthoimage": ("evaluate_ortho",),
        "model.errors": ("InputError", "OrthoSwarmError"),
        "model.frame": ("Fix", "Frame", "Ingest", "Rejection"),
        "model.plan": ("Plan",),
        "model.task_runner": ("Progress",),
    },
)
