"""Missions: items, upload, download, commands, and detection of completion.

Nothing here uses sockets or clocks: messages and the time are passed in, messages are returned.
"""
