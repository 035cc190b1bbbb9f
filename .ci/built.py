"""Build hook of hatch: packages say the commit that they were built of, and a wheel carries the compiled kernels.

If `orthoswarm.compute.compile_kernels` ran before, it does; it is then for this Python and platform, and asks for
the numba that they were compiled with: others cannot load them. Without them the wheel is pure, and the first run
compiles.
"""

import json
import subprocess
import sys
from pathlib import Path

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

FOLDER = "orthoswarm/compute/compiled"
COMMIT = "orthoswarm/commit.txt"


class Built(BuildHookInterface):
    """Adds the commit, and to a wheel the kernels, the tag of the platform and the exact numba."""

    def initialize(self, version, build_data):
        """Hatch calls it before it collects the files."""
        if version == "editable":
            return
        if Path(self.root, ".git").exists():  # else this is a source package, which says it already
            describe = ["git", "describe", "--always", "--dirty", "--exclude=*"]
            told = subprocess.run(describe, cwd=self.root, capture_output=True, text=True, check=False)
            Path(self.directory).mkdir(parents=True, exist_ok=True)
            file = Path(self.directory, "commit.txt")
            file.write_text(told.stdout, encoding="utf-8")
            build_data["force_include"][str(file)] = COMMIT
        if self.target_name == "wheel":
            self._add_kernels(build_data)

    def finalize(self, version, build_data, artifact):
        """Hatch calls it after it wrote the package."""
        Path(self.directory, "commit.txt").unlink(missing_ok=True)

    def _add_kernels(self, build_data):
        made = Path(self.root, FOLDER, "made_for.json")
        if not made.exists():
            return
        made_for = json.loads(made.read_text(encoding="utf-8"))
        baseline = made_for["processor"] in ("x86-64-v3", "generic")
        if baseline and made_for["python"] == list(sys.version_info[:2]):
            build_data["artifacts"].append(f"/{FOLDER}/")
            build_data["dependencies"].append(f"numba=={made_for['numba']}")
            build_data |= {"pure_python": False, "infer_tag": True}
