"""The listening socket of the web server."""

import socket

from orthoswarm.model.errors import InputError


def open_listener(address: str, port: int) -> socket.socket:
    """A bound TCP socket without Nagle's algorithm on its connections.

    The protocol is stated because asyncio sets TCP_NODELAY only on sockets with IPPROTO_TCP. With Nagle's algorithm an
    answer on a persistent connection waits for the client's delayed acknowledgement, 40 ms on Linux.

    Args:
        address: IPv4 or IPv6 address, or a host name. port: 0 for any free one.

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
