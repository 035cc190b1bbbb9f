"""The settings that a run is given: read from a file, checked, and compared with what is usual."""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Final

from orthoswarm.config.autopilot import ARDUPILOT, DJI, PX4, AutopilotTimes
from orthoswarm.config.mapping import (
    ComputeConfig,
    MatchersConfig,
    MosaicConfig,
    RasterConfig,
    StereoConfig,
    StrategyConfig,
)
from orthoswarm.config.planning import PLANNING, PlanningConfig
from orthoswarm.config.ranges import range_of
from orthoswarm.model.errors import InputError


@dataclass(frozen=True, slots=True, kw_only=True)
class Config:
    """The settings of all stages. Entry points take it, and hand each stage its own."""

    planning: PlanningConfig = PLANNING
    ardupilot: AutopilotTimes = ARDUPILOT
    px4: AutopilotTimes = PX4
    strategy: StrategyConfig = field(default_factory=StrategyConfig)
    matchers: MatchersConfig = field(default_factory=MatchersConfig)
    mosaic: MosaicConfig = field(default_factory=MosaicConfig)
    stereo: StereoConfig = field(default_factory=StereoConfig)
    raster: RasterConfig = field(default_factory=RasterConfig)
    compute: ComputeConfig = field(default_factory=ComputeConfig)

    def times(self, autopilot: str) -> AutopilotTimes:
        """Those of PX4 or ArduCopter by these names, `px4` and `ardupilot`; of any other, those of DJI's drones."""
        return {"px4": self.px4, "ardupilot": self.ardupilot}.get(autopilot, DJI)


DEFAULT: Final = Config()
"""What is usual."""


def read_config(path: Path | None) -> Config:
    """The settings of a TOML file, what is usual where it says nothing; without a file all that is usual.

    Raises:
        InputError: the file cannot be read, or holds something else.
    """
    if path is None:
        return DEFAULT
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8-sig"))
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error.strerror}); check the name") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path} is not a TOML file ({error}); write a table for each stage, for example [stereo]"
        ) from None
    return config_of(values)


def config_of(values: Mapping[str, Any]) -> Config:
    """The settings where these values (stage -> name -> value) stand in the place of usual ones.

    Raises:
        InputError: a stage or setting does not exist, or a value is of another kind than the usual one or out of range.
    """
    stages = {f.name: getattr(DEFAULT, f.name) for f in fields(Config)}
    for stage, changed in values.items():
        if stage not in stages:
            raise InputError(
                f"there are no settings [{stage}], or no longer: they are fixed now; remove them; there are: "
                f"{', '.join(stages)}"
            )
        if not isinstance(changed, Mapping):
            raise InputError(f"'{stage}' in the configuration is a value; write it as a table: [{stage}]")
        usual = stages[stage]
        stages[stage] = replace(usual, **{name: _checked(stage, usual, name, value) for name, value in changed.items()})
    return Config(**stages)


def changes(config: Config) -> dict[str, dict[str, Any]]:
    """What differs from what is usual, as stage -> name -> value; see `config_of`."""
    found = {
        stage.name: {
            f.name: getattr(own, f.name) for f in fields(own) if getattr(own, f.name) != getattr(usual, f.name)
        }
        for stage in fields(Config)
        for own, usual in [(getattr(config, stage.name), getattr(DEFAULT, stage.name))]
    }
    return {stage: changed for stage, changed in found.items() if changed}


def _checked(stage: str, usual: Any, name: str, value: Any) -> Any:
    """A value of the kind that the usual one has, and in its range.

    Raises:
        InputError: it is of another kind or out of range, or there is no such setting.
    """
    known = {f.name: f for f in fields(usual)}
    if name not in known:
        raise InputError(
            f"there is no setting {stage}.{name}, or no longer: it is fixed now; remove it; [{stage}] has: "
            f"{', '.join(known)}"
        )
    said = f"[{stage}] {name} = {value!r} in the configuration"
    default = getattr(usual, name)
    kinds = int | float if isinstance(default, float) else type(default)
    if isinstance(value, bool) or not isinstance(value, kinds):
        raise InputError(f"{said} is of another kind than {default!r}")
    if isinstance(default, str):
        return value
    if value not in (allowed := range_of(known[name])):
        raise InputError(f"{said} is out of range; give a number {allowed}")
    return float(value) if isinstance(default, float) else value
