"""Build hook of hatch: a wheel carries the compiled kernels if `orthoswarm.compute.compile_kernels` ran before.

It is then for this Python and platform, and asks for the numba that they were compiled with: others cannot load them.
Without them the wheel is pure, and the first run compiles.
"""

import json
import sys
from pathlib import Path

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FOLDER = "orthoswarm/compute/compiled"


class KernelsInWheel(BuildHookInterface):
    """Adds the folder, the tag of the platform and the exact numba to a wheel."""

    def initialize(self, version, build_data):
        """Hatch calls it before it collects the files."""
        made = Path(self.root, FOLDER, "made_for.json")
        if version == "editable" or not made.exists():
            return
        made_for = json.loads(made.read_text(encoding="utf-8"))
        baseline = made_for["processor"] in ("x86-64-v3", "generic")
        if baseline and made_for["python"] == list(sys.version_info[:2]):
            build_data["artifacts"].append(f"/{FOLDER}/")
            build_data["dependencies"].append(f"numba=={made_for['numba']}")
            build_data |= {"pure_python": False, "infer_tag": True}
