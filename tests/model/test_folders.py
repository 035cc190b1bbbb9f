"""A folder holds one idea: at most fifteen modules, and a sentence that says what they are."""

import ast
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MOST = 15
TREES = ("orthoswarm", "telemetry", "gcs_plugin", "benchmarks", "tests")


@pytest.mark.parametrize("tree", TREES)
def test_no_folder_is_crowded(tree):
    modules = Counter(path.parent for path in (ROOT / tree).rglob("*.py") if path.name != "__init__.py")
    crowded = {str(folder.relative_to(ROOT)): count for folder, count in modules.items() if count > MOST}
    assert not crowded, "divide these by idea"


@pytest.mark.parametrize("tree", ["orthoswarm", "telemetry", "gcs_plugin", "benchmarks"])
def test_every_room_says_what_it_is(tree):
    rooms = {path.parent for path in (ROOT / tree).rglob("*.py")}
    silent = [
        str(room.relative_to(ROOT))
        for room in sorted(rooms)
        if not (room / "__init__.py").is_file()
        or not ast.get_docstring(ast.parse((room / "__init__.py").read_text(encoding="utf-8")))
    ]
    assert not silent, "give these an __init__.py with one sentence"
