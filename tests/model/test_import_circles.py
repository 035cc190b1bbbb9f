"""No module of a package imports one that imports it back, in a function or not: the data's way is a straight line."""

import ast
import graphlib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def imports_of(package: str) -> dict[str, set[str]]:
    """Module -> modules of the same package that it imports anywhere."""
    graph = {}
    for path in sorted((ROOT / package).rglob("*.py")):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        found = set()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and node.module:
                found |= {node.module, *(f"{node.module}.{alias.name}" for alias in node.names)}
        graph[name] = found
    # A package's own __init__ offers what its modules hold, so it may come after them and before them.
    return {name: {f for f in found if f in graph and f != name and "." in f} for name, found in graph.items()}


@pytest.mark.parametrize("package", ["telemetry", "gcs_plugin"])
def test_imports_form_no_circle(package):
    graphlib.TopologicalSorter(imports_of(package)).prepare()
