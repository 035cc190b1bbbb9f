"""A slow network on loopback: connections through which every byte arrives later, in both directions."""

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager


class DelayedNetwork:
    """Forwards ports; what is sent arrives after half the round trip.

    Attributes:
        bytes_sent: sum over all connections and both directions.
    """

    def __init__(self, round_trip_s: float) -> None:
        self._half_s = round_trip_s / 2
        self._loop = asyncio.new_event_loop()
        self.bytes_sent = 0
        threading.Thread(target=self._loop.run_forever, daemon=True).start()

    def forward(self, port: int) -> int:
        """The port behind which another port of this machine is reached slowly."""
        return asyncio.run_coroutine_threadsafe(self._listen(port), self._loop).result(30)

    def close(self) -> None:
        """Stop forwarding."""
        self._loop.call_soon_threadsafe(self._loop.stop)

    async def _listen(self, port: int) -> int:
        async def connected(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            try:
                to_reader, to_writer = await asyncio.open_connection("127.0.0.1", port)
            except OSError:
                writer.close()
                return
            await asyncio.gather(self._pipe(reader, to_writer), self._pipe(to_reader, writer))

        server = await asyncio.start_server(connected, "127.0.0.1", 0)
        return int(server.sockets[0].getsockname()[1])

    async def _pipe(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """What is read is written later, in the same order; reading goes on meanwhile."""
        waiting: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(maxsize=4096)

        async def write() -> None:
            while True:
                due, data = await waiting.get()
                await asyncio.sleep(max(0.0, due - self._loop.time()))
                if not data:
                    writer.close()
                    return
                writer.write(data)
                self.bytes_sent += len(data)
                await writer.drain()

        writing = asyncio.create_task(write())
        try:
            while data := await reader.read(1 << 18):
                await waiting.put((self._loop.time() + self._half_s, data))
        except OSError:
            pass
        await waiting.put((self._loop.time() + self._half_s, b""))
        try:
            await writing
        except OSError:
            writer.close()


@contextmanager
def delayed_network(round_trip_s: float) -> Iterator[DelayedNetwork]:
    """A network that ends with the context."""
    network = DelayedNetwork(round_trip_s)
    try:
        yield network
    finally:
        network.close()
