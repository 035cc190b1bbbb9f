"""Pictures and poses of videos, from files and live."""
