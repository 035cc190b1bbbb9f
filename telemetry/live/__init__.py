"""Poses and pictures as they arrive: a vehicle's recent poses, video streams, DroneCAN."""
