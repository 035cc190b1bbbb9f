"""What a user may set: one frozen dataclass a stage, each field with unit, meaning and source.

`--config FILE.toml` of `orthoswarm mosaic`, `plan` and `serve` has a table a stage:

    [stereo]
    tallest_m = 120

A number outside its range (`ranges`) is refused. Whoever needs a setting is handed its stage as an argument; all other
thresholds are constants beside their use.
"""

from orthoswarm.config.settings import DEFAULT, Config, changes, config_of, read_config

__all__ = ["DEFAULT", "Config", "changes", "config_of", "read_config"]
