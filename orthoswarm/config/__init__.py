"""Every threshold: one frozen dataclass a stage, each field with unit, meaning and source.

`active()` gives the values in force. `--config FILE.toml` of `orthoswarm mosaic`, `plan` and `serve` overrides
them, a table a stage:

    [features]
    corner_distance_px = 12

A number outside its range (`ranges`) is refused.

What is a definition and no choice (a layout of arrays, a unit) stays beside its code.
"""

from orthoswarm.config.active import Config, Overrides, active, overridden, override, read_overrides

__all__ = ["Config", "Overrides", "active", "overridden", "override", "read_overrides"]
