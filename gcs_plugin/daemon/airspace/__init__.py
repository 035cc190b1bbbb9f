"""What bounds the flight: other aircraft, geofences, and the terrain that vehicles follow."""
