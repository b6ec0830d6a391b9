"""Running the block service in this process: a listening socket, and a loop that ends on SIGINT and SIGTERM."""

import signal
import socket
from collections.abc import Callable
from typing import Final

import uvicorn
from fastapi import FastAPI

from schemas.errors import StorageError, UsageError

_KEEP_ALIVE_S: Final = 60
"""Longer than a viewer stands still between two movements, so that its pooled connections are still open."""
_SHUTDOWN_S: Final = 5
"""How long running answers may take to finish once the service is told to stop."""


def listen(host: str, port: int) -> socket.socket:
    """Return a socket bound to ``host`` and ``port`` (0: any free one).

    Raises UsageError if there is no such host, StorageError if the address cannot be had.
    """
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    except OSError as error:
        raise UsageError(f"{host}: no such address to listen on ({error.strerror})") from error
    listener = socket.socket(family, kind, protocol)
    try:
        # A port left a moment ago by an earlier run is free for this one.
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen()
    except OSError as error:
        listener.close()
        raise StorageError(f"{host} port {port}: cannot listen there: {error.strerror}; choose another port or address") from error
    return listener


def url_of(listener: socket.socket) -> str:
    """Return the URL under which ``listener`` is reached."""
    host, port = listener.getsockname()[:2]
    return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"


class _Server(uvicorn.Server):
    def __init__(self, config: uvicorn.Config, ready: Callable[[], None]) -> None:
        super().__init__(config)
        self._ready = ready

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        self._ready()


def run_until_stopped(app: FastAPI, listener: socket.socket, *, access_log: bool, ready: Callable[[], None]) -> None:
    """Answer requests until SIGINT or SIGTERM; calls ``ready`` once requests are answered."""
    config = uvicorn.Config(
        app,
        log_config=None,
        access_log=access_log,
        lifespan="off",
        ws="none",
        server_header=False,
        timeout_keep_alive=_KEEP_ALIVE_S,
        timeout_graceful_shutdown=_SHUTDOWN_S,
    )
    server = _Server(config, ready)
    # uvicorn raises a signal again after its shutdown. With its own handler in place that is the end of it, and a signal
    # that comes before uvicorn is ready is not lost.
    previous = {number: signal.signal(number, server.handle_exit) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        server.run(sockets=[listener])
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
