"""Reading what an earlier version kept: dataclasses with slots that have more fields now than they had then."""

from dataclasses import MISSING, Field, fields
from typing import Any


def set_fields(one: Any, state: Any) -> None:
    """Set the fields of a dataclass with slots from its pickled state (for its `__setstate__`).

    Args:
        one: the object, without values yet.
        state: list of the values of the first fields (frozen dataclasses) or (None, name -> value); fields that are
            not in it get their defaults.
    """
    own = fields(one)
    kept = state[1] if isinstance(state, tuple) else {f.name: value for f, value in zip(own, state)}
    for f in own:
        object.__setattr__(one, f.name, kept[f.name] if f.name in kept else _default(f))


def _default(f: "Field[Any]") -> Any:
    return f.default if f.default_factory is MISSING else f.default_factory()
