"""Vehicles on the links as plans know them, without links."""

from dataclasses import dataclass, field


@dataclass
class OnLinks:
    """Vehicles by id: their autopilots, and where they stand."""

    kinds: dict = field(default_factory=dict)
    places: dict = field(default_factory=dict)

    def autopilots(self):
        return self.kinds

    def standing(self):
        return self.places
