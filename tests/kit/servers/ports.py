"""Ports of the loopback that nobody else takes between their choice and their use."""

import os
import random
import socket

_PORTS = range(20_000, 32_000)
"""Below those that systems give to outgoing connections (Linux: from 32768): one of these may be taken by a connection
of another process before the server that it was chosen for begins."""
_drawn = random.Random(os.getpid())


def free_port() -> int:
    """A port that is free for TCP and UDP."""
    while True:
        port = _drawn.choice(_PORTS)
        try:
            with socket.socket() as stream, socket.socket(type=socket.SOCK_DGRAM) as datagrams:
                stream.bind(("127.0.0.1", port))
                datagrams.bind(("127.0.0.1", port))
        except OSError:
            continue
        return port
