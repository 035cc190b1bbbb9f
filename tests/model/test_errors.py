"""The hierarchy of failures: drawn completely, and each of them told apart by type."""

import importlib
import pkgutil

import pytest

import gcs_plugin
import orthoswarm
import telemetry
from orthoswarm.model import errors
from orthoswarm.model.errors import OrthoSwarmError


def imported(package):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if module.name.endswith("__main__"):
            continue
        try:
            importlib.import_module(module.name)
        except ImportError:  # of an optional extra
            continue


def descendants(cls):
    for child in cls.__subclasses__():
        yield child
        yield from descendants(child)


@pytest.mark.slow
def test_the_tree_shows_every_failure_below_its_parent():
    for package in (orthoswarm, telemetry, gcs_plugin):
        imported(package)
    lines = errors.__doc__.splitlines()
    column = {line.split("── ")[1].split()[0]: (n, line.index("── ")) for n, line in enumerate(lines) if "── " in line}
    found = {
        c
        for c in descendants(OrthoSwarmError)
        if c.__module__.split(".")[0] in ("orthoswarm", "telemetry", "gcs_plugin")
    }
    assert len(found) > 5
    for cls in found:
        assert cls.__name__ in column, f"{cls.__module__}.{cls.__name__} is not in the tree of orthoswarm.model.errors"
        (line, indent), (above, outer) = column[cls.__name__], column[cls.__base__.__name__]
        assert above < line and indent == outer + 4, f"{cls.__name__} is not drawn below {cls.__base__.__name__}"
