"""What a flight may use: height, flight time and battery, where plan and user do not say it."""

from typing import Final

LEGAL_HEIGHT_M: Final = 120.0
"""Height up to which drones fly without a permit in the EU (2019/947, UAS.OPEN.010); 400 ft in the US."""
ENDURANCE_S: Final = 1200.0
"""Flight time of a full battery where the plan does not say it."""
RESERVE: Final = 0.2
"""Share of the battery that is to be left after landing."""
