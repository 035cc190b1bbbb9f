"""What a user may set: one frozen dataclass a stage, each field with unit, meaning and source.

`active()` gives the values in force. `--config FILE.toml` of `orthoswarm mosaic`, `plan` and `serve` overrides
them, a table a stage:

    [features]
    cell_px = 60

A number outside its range (`ranges`) is refused.

All other thresholds are constants beside their use.
"""

from orthoswarm.config.active import Config, Overrides, active, overridden, override, read_overrides

__all__ = ["Config", "Overrides", "active", "overridden", "override", "read_overrides"]
