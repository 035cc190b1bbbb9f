"""Six and more values are handed over by name, so that no two of them can be mixed up."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MOST = 5  # arguments by position
PACKAGES = ("orthoswarm", "telemetry", "gcs_plugin")


def by_position(node: ast.AST) -> int:
    """How many arguments a function, or the constructor of a dataclass, takes by position."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
        if any(ast.unparse(d) in ("kernel", "in_place_kernel", "intrinsic") for d in node.decorator_list):
            return 0  # compiled by numba, which dispatches on positions
        names = [a.arg for a in node.args.posonlyargs + node.args.args]
        return len(names) - (names[:1] in (["self"], ["cls"]))
    if isinstance(node, ast.ClassDef):
        made = [ast.unparse(d) for d in node.decorator_list if "dataclass" in ast.unparse(d)]
        if not made or "kw_only=True" in made[0]:
            return 0
        count = 0
        for field in node.body:
            if not isinstance(field, ast.AnnAssign) or "ClassVar" in ast.unparse(field.annotation):
                continue
            if ast.unparse(field.annotation) == "KW_ONLY":
                break
            count += "init=False" not in (ast.unparse(field.value) if field.value else "")
        return count
    return 0


@pytest.mark.parametrize("package", PACKAGES)
def test_many_arguments_are_keywords(package):
    many = [
        f"{path.relative_to(ROOT)}:{node.lineno} {node.name} takes {by_position(node)}"
        for path in sorted((ROOT / package).rglob("*.py"))
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if by_position(node) > MOST
    ]
    assert not many, "give dataclasses kw_only=True and functions a `*`:\n" + "\n".join(many)


def test_the_rule_sees_what_it_forbids():
    six = ", ".join("abcdef")
    fields = "\n    ".join(f"{name}: int" for name in "abcdef")
    (function,) = ast.parse(f"def f({six}): ...").body
    (method,) = ast.parse(f"def f(self, {six}, *, g): ...").body
    (record,) = ast.parse(f"@dataclass(frozen=True)\nclass A:\n    {fields}").body
    (named,) = ast.parse(f"@dataclass(kw_only=True)\nclass A:\n    {fields}").body
    assert [by_position(node) for node in (function, method, record, named)] == [6, 6, 6, 0]
