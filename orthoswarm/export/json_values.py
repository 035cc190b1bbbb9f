"""Numbers and documents that every reader of JSON understands: NaN and infinity are null."""

import json
import math
from collections.abc import Mapping
from typing import Any


def finite(value: float | None) -> float | None:
    """A number that JSON can hold; None for none, NaN and infinity."""
    return None if value is None or not math.isfinite(value) else float(value)


def json_text(document: Any, indent: int | None = None, *, compact: bool = False) -> str:
    """A document as JSON in which numbers that are not finite are null; compact: without spaces, in ASCII alone."""
    form: dict[str, Any] = {"separators": (",", ":")} if compact else {"indent": indent, "ensure_ascii": False}
    try:
        return json.dumps(document, allow_nan=False, **form)
    except ValueError:
        return json.dumps(_with_nulls(document), allow_nan=False, **form)


def _with_nulls(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _with_nulls(v) for key, v in value.items()}
    if isinstance(value, list | tuple):
        return [_with_nulls(v) for v in value]
    return finite(value) if isinstance(value, float) else value
