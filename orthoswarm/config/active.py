"""The configuration in force, in this process and in those that work for it."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cache
from pathlib import Path
from typing import Any

from orthoswarm.config.autopilot import ArduPilotConfig, Px4Config
from orthoswarm.config.mapping import (
    ComputeConfig,
    MatchersConfig,
    MosaicConfig,
    RasterConfig,
    StereoConfig,
    StrategyConfig,
)
from orthoswarm.config.planning import PlanningConfig
from orthoswarm.config.ranges import numbers_in, range_of, rises
from orthoswarm.model.errors import InputError

Overrides = Mapping[str, Mapping[str, Any]]
"""Stage -> field -> value that differs from the default."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Config:
    """The thresholds of all stages."""

    planning: PlanningConfig = field(default_factory=PlanningConfig)
    ardupilot: ArduPilotConfig = field(default_factory=ArduPilotConfig)
    px4: Px4Config = field(default_factory=Px4Config)
    strategy: StrategyConfig = field(default_factory=StrategyConfig)
    matchers: MatchersConfig = field(default_factory=MatchersConfig)
    mosaic: MosaicConfig = field(default_factory=MosaicConfig)
    stereo: StereoConfig = field(default_factory=StereoConfig)
    raster: RasterConfig = field(default_factory=RasterConfig)
    compute: ComputeConfig = field(default_factory=ComputeConfig)


_DEFAULT = Config()
_active = _DEFAULT
_overridden: Overrides = {}


def active() -> Config:
    """The values in force in this process."""
    return _active


def overridden() -> Overrides:
    """What differs from the defaults in this process; workers are given it with every task."""
    return _overridden


def override(values: Overrides) -> None:
    """Put values in the place of defaults, in this process; an empty mapping restores the defaults.

    Raises:
        InputError: a stage or field does not exist, or a value has another kind than the default or is out of range.
    """
    global _active, _overridden
    if values == _overridden:
        return
    stages: dict[str, Any] = {}
    for stage, changes in values.items():
        if stage not in _names():
            raise InputError(f"there are no settings [{stage}]; remove them; there are: {', '.join(_names())}")
        if not isinstance(changes, Mapping):
            raise InputError(f"'{stage}' in the configuration is a value; write it as a table: [{stage}]")
        default = getattr(_DEFAULT, stage)
        stages[stage] = replace(default, **{name: _checked(stage, name, value) for name, value in changes.items()})
    _active, _overridden = replace(_DEFAULT, **stages), values


def read_overrides(path: Path) -> Overrides:
    """The overrides of a TOML file.

    Raises:
        InputError: the file cannot be read, or holds something else.
    """
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); check the name") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path} is not a TOML file ({error}); write a table for each stage, for example [features]"
        ) from None
    before = overridden()
    try:
        override(values)  # says what is wrong with it
    finally:
        override(before)
    return values


@cache
def _names() -> tuple[str, ...]:
    return tuple(f.name for f in fields(Config))


def _checked(stage: str, name: str, value: Any) -> Any:
    """A value of the kind that the default has, and in its range; lists become tuples.

    Raises:
        InputError: it is of another kind or out of range, or there is no such field.
    """
    known = {f.name: f for f in fields(getattr(_DEFAULT, stage))}
    if name not in known:
        raise InputError(f"there is no setting {stage}.{name}; remove it; [{stage}] has: {', '.join(known)}")
    declared = known[name]
    said = f"[{stage}] {name} = {value!r} in the configuration"
    value = _tuples(value)
    if not _alike(value, declared.default):
        raise InputError(f"{said} is of another kind than {declared.default!r}")
    allowed, numbers = range_of(declared), list(numbers_in(value))
    if allowed is not None and not all(number in allowed for number in numbers):
        each = "numbers" if isinstance(value, tuple) else "a number"
        raise InputError(f"{said} is out of range; give {each} {allowed}")
    if rises(declared) and numbers[0] > numbers[1]:
        raise InputError(f"{said} is the wrong way round; give the smaller number first")
    return _as_default(value, declared.default)


def _tuples(value: Any) -> Any:
    return tuple(map(_tuples, value)) if isinstance(value, list | tuple) else value


def _alike(value: Any, default: Any) -> bool:
    """True if a value has the kind of the default; a whole number may stand for any other."""
    if isinstance(default, tuple):
        same = isinstance(value, tuple) and len(value) == len(default)
        return same and all(map(_alike, value, default))
    if isinstance(value, bool) or isinstance(default, bool):
        return isinstance(value, bool) and isinstance(default, bool)
    return isinstance(value, int | float if isinstance(default, float) else type(default))


def _as_default(value: Any, default: Any) -> Any:
    """A value with whole numbers made floats where the default is one."""
    if isinstance(default, tuple):
        return tuple(map(_as_default, value, default))
    return float(value) if isinstance(default, float) else value
