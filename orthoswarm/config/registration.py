"""Registration onto the map and onto neighbours."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class RegistrationConfig:
    """Registration onto the map and onto neighbours."""
