"""The documents name what is in the tree: rooms with a sentence each, modules, benchmarks, links that lead on."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("orthoswarm", "telemetry", "gcs_plugin")
TEXT = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
_NAME = re.compile(r"`([A-Za-z_][\w./]*)`")
# Names of files and entry points that are no modules of this tree.
_OTHER = {"frames.jsonl", "pyproject.toml", "orthoswarm.sei", "orthoswarm.matchers"}


def named() -> list[str]:
    return sorted(set(_NAME.findall(TEXT)) - _OTHER)


def symbols() -> set[str]:
    """Names of all functions, classes and constants of the three packages."""
    found: set[str] = set()
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
                    found.add(node.name)
                elif isinstance(node, ast.Assign):
                    found.update(target.id for target in node.targets if isinstance(target, ast.Name))
                elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
                    found.add(node.target.id)
    return found


def paths() -> set[str]:
    """Each module and room, written with slashes, without suffix: "orthoswarm/model/frame"."""
    found = set()
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            relative = path.relative_to(ROOT)
            found.add(str(relative.parent if path.name == "__init__.py" else relative.with_suffix("")))
    return found


def test_named_modules_exist():
    present, known = paths(), symbols()
    missing = []
    for name in named():
        path = name.removesuffix(".py").rstrip("/").replace(".", "/")
        if not any(other == path or other.endswith("/" + path) for other in present) and name not in known:
            missing.append(name)
    assert not missing, "docs/architecture.md names what is not in the tree"


@pytest.mark.parametrize("package", PACKAGES)
def test_every_room_has_its_row(package):
    rooms = TEXT[TEXT.index("## Every room") : TEXT.index("## Where to add")]
    words = {part for name in _NAME.findall(rooms) for part in re.split(r"[./]", name)}
    folders = {path.parent.relative_to(ROOT) for path in (ROOT / package).rglob("__init__.py")}
    silent = [str(folder) for folder in sorted(folders) if folder.name not in words]
    assert not silent, "give these a sentence in docs/architecture.md"


def test_the_pages_stay_three():
    assert len(TEXT.splitlines()) <= 180


DOCUMENTS = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]


def _headings(path: Path) -> set[str]:
    """The anchors of a document's headings, as GitHub makes them."""
    lines = [
        line.lstrip("#").strip().lower() for line in path.read_text(encoding="utf-8").splitlines() if line[:1] == "#"
    ]
    return {re.sub(r"[^\w\- ]", "", line).replace(" ", "-") for line in lines}


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: path.name)
def test_documents_name_what_exists(path):
    text = path.read_text(encoding="utf-8")
    for target, anchor in re.findall(r"\]\((?!https?:)([^)#\s]*)#?([^)\s]*)\)", text):
        linked = path.parent / target if target else path
        assert linked.exists(), f"there is no {target}"
        assert not anchor or anchor in _headings(linked), f"{linked.name} has no heading for #{anchor}"
    for module in re.findall(r"python -m (benchmarks[\w.]+)", text):
        path = ROOT / module.replace(".", "/")
        assert path.with_suffix(".py").is_file() or (path / "__main__.py").is_file(), f"there is no {module}"
    for file in re.findall(r"`((?:orthoswarm|telemetry|gcs_plugin|benchmarks|docs)/[\w/.]+)`", text):
        assert (ROOT / file).exists(), f"there is no {file}"


QUOTED = re.findall(
    r"In `([^`]+)`:\n\n```python\n(.*?)```", (ROOT / "docs" / "style.md").read_text(encoding="utf-8"), re.S
)


@pytest.mark.parametrize(("path", "quote"), QUOTED, ids=[path for path, _ in QUOTED])
def test_quoted_code_is_what_stands_in_the_file(path, quote):
    """Word for word and in its order; a line of three dots stands for lines left out."""
    source, at = (ROOT / path).read_text(encoding="utf-8"), 0
    for part in re.split(r"^ *\.\.\.\n", quote, flags=re.MULTILINE):
        found = source.find(part, at)
        assert found >= 0, f"{path} has no longer:\n{part}"
        at = found + len(part)


def test_all_code_of_the_style_is_quoted_from_a_file():
    assert len(QUOTED) == (ROOT / "docs" / "style.md").read_text(encoding="utf-8").count("```python") > 0
