"""The socket on which HTTP is served."""

import socket

from orthoswarm.model.errors import InputError


def open_listener(address: str, port: int) -> socket.socket:
    """A bound TCP socket whose connections send each answer at once.

    The protocol is named because asyncio switches Nagle's algorithm off (TCP_NODELAY) only where a socket says that it
    is TCP; with it, an answer on a kept connection waits for the client's delayed acknowledgement, 40 ms on Linux.

    Args:
        address: IPv4 or IPv6 address, or a host name. port: 0 takes any free one.

    Raises:
        InputError: it cannot be bound.
    """
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind((address, port))
    except (OSError, UnicodeError) as error:
        listener.close()
        reason = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{address}:{port} cannot be served ({reason}); choose another --port or --bind") from None
    return listener
