"""The default refiner: exterior and interior orientation of all photos of a vehicle, then onto the map.

Rooms, from the ground up: bundle, features, initial, flight, surface, registration, strategy. Each imports only rooms
named before it.
"""
