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


def _named_after_others(path: Path) -> bool:
    """Whether a module has the name of what it configures, or of the verb that it runs."""
    return "config" in path.parts or "verbs" in path.parts


def test_no_name_stands_for_two_things():
    places: dict[str, list[str]] = {}
    for tree in ("orthoswarm", "telemetry", "gcs_plugin"):
        for path in (ROOT / tree).rglob("*.py"):
            if path.name == "__init__.py":
                path, name = path.parent, path.parent.name
            else:
                name = path.stem
            # A room's main module has the room's name (canvas/canvas.py).
            if not _named_after_others(path.relative_to(ROOT)) and name != "__main__" and path.parent.name != name:
                places.setdefault(name, []).append(str(path.relative_to(ROOT)))
    assert not {name: where for name, where in places.items() if len(where) > 1}


def test_no_class_name_stands_for_two_things():
    places: dict[str, list[str]] = {}
    for tree in ("orthoswarm", "telemetry", "gcs_plugin"):
        for path in (ROOT / tree).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.ClassDef):
                    places.setdefault(node.name, []).append(str(path.relative_to(ROOT)))
    assert not {name: where for name, where in places.items() if len(where) > 1}


def test_no_two_tests_have_one_name():
    names = Counter(path.name for path in (ROOT / "tests").rglob("test_*.py"))
    assert not [name for name, count in names.items() if count > 1]
