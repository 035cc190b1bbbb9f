"""Missions: what they consist of, how they get into a vehicle and back, and when a vehicle has flown one.

Everything here is free of sockets and clocks: messages and the time go in, messages come out.
"""
