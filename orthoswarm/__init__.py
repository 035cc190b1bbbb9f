"""OrthoSwarm's mapping core: from frames with rough poses to a georeferenced orthoimage.

Arrays and value types in and out; no sockets, no web, no clock.
"""

__version__ = "0.1.0"
