"""Missions that the app of a drone's maker flies, as files: DJI's WPML for Pilot 2, and Litchi's CSV."""
