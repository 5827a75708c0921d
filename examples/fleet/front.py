# SPDX-FileCopyrightText: The vla.cpp authors
# SPDX-License-Identifier: Apache-2.0
"""The door of the fleet: robots connect by WebSocket and speak openpi's protocol. What answers them is given; Ray is not known here.

A robot's name is the path of its address: ws://HOST:8000/arm-7. Without one each connection is a robot of its own.
"""

import asyncio
import contextlib
import functools
from collections import Counter
from http import HTTPStatus
from typing import Awaitable, Callable, Dict, Optional, Set, Union

from websockets.asyncio.server import Request, Response, ServerConnection, serve
from websockets.exceptions import ConnectionClosed

Answer = Union[bytes, str]  # text refuses, as in openpi: the connection ends after it
MAX_MESSAGE = 32 << 20  # bytes, as vla serve takes them
HANDSHAKE = 5.0  # seconds, from a connection to the robot's request and its answer
GOING_AWAY, REFUSED, RESTARTS = 1001, 1011, 1012  # RFC 6455 and its registry


class Lost(Exception):
    """Whoever computed the act died, and so did whoever was asked in its place."""


class _Connection(ServerConnection):
    """Tells the front when it comes and goes; `_handle` tells that its handshake is done."""

    def __init__(self, *arguments, front: "Front", **more) -> None:
        super().__init__(*arguments, **more)
        self._front = front

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._front.arrive(self)

    def connection_lost(self, problem: Optional[Exception]) -> None:
        self._front.arrived(self)
        super().connection_lost(problem)


class Front:
    """Answers robots until it drains.

    greet  of a robot's name: the metadata, which openpi's servers send first
    act    of a robot's name and its message: the answer. May raise Lost
    limit  connections at once
    most_handshakes
           of them that are not done; one more ends the oldest of the address that has most
    """

    def __init__(
        self,
        greet: Callable[[str], Awaitable[Answer]],
        act: Callable[[str, bytes], Awaitable[Answer]],
        limit: int = 1024,
        most_handshakes: int = 64,
    ) -> None:
        self._greet, self._act, self._limit, self._most_handshakes = greet, act, limit, most_handshakes
        self._arriving: Dict[_Connection, str] = {}  # whose handshake is not done, oldest first, with their addresses
        self._open: Set[ServerConnection] = set()
        self._idle: Set[ServerConnection] = set()  # those of them that have no act under way
        self._draining = False

    def listen(self, host: str, port: int):
        """An asynchronous context: the listening server, whose sockets tell the port that port 0 became."""
        return serve(
            self._handle,
            host,
            port,
            process_request=self._before,
            compression=None,
            max_size=MAX_MESSAGE,
            server_header=None,
            open_timeout=HANDSHAKE,
            create_connection=functools.partial(_Connection, front=self),
        )

    def arrive(self, connection: _Connection) -> None:
        self._arriving[connection] = str((connection.transport.get_extra_info("peername") or [""])[0])
        if len(self._arriving) > self._most_handshakes:
            [(address, _)] = Counter(self._arriving.values()).most_common(1)
            oldest = next(other for other, its in self._arriving.items() if its == address)
            self.arrived(oldest)
            oldest.transport.abort()

    def arrived(self, connection: _Connection) -> None:
        self._arriving.pop(connection, None)

    async def drain(self, patience: float = 30.0) -> None:
        """Tells each robot to connect elsewhere, once the act that it waits for is answered; `patience` in seconds."""
        self._draining = True
        await asyncio.gather(*(self._send_away(connection) for connection in list(self._idle)))
        until = asyncio.get_running_loop().time() + patience
        while self._open and asyncio.get_running_loop().time() < until:
            await asyncio.sleep(0.01)

    def _before(self, connection: ServerConnection, request: Request) -> Optional[Response]:
        """The answer to a request that is no robot's, or one too many."""
        if "Origin" in request.headers:  # a web page could drive the robot of the person who reads it
            return connection.respond(HTTPStatus.FORBIDDEN, "no browsers\n")
        if request.path == "/healthz":
            return connection.respond(HTTPStatus.OK, "OK\n")
        if self._draining:
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "draining\n")
        if request.path == "/readyz":
            return connection.respond(HTTPStatus.OK, "OK\n")
        if len(self._open) >= self._limit:
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, "too many connections\n")
        return None

    async def _handle(self, connection: _Connection) -> None:
        self.arrived(connection)
        robot = connection.request.path.strip("/") or str(connection.id)
        self._open.add(connection)
        try:
            await self._say(connection, await self._greet(robot))
            async for message in connection:
                self._idle.discard(connection)
                await self._say(connection, await self._act(robot, message))
        except Lost as problem:
            await connection.close(RESTARTS, f"{problem}; connect again")
        except ConnectionClosed:
            pass  # the robot is gone, and with it whoever waited for the answer
        finally:
            self._open.discard(connection)
            self._idle.discard(connection)

    async def _say(self, connection: ServerConnection, answer: Answer) -> None:
        await connection.send(answer)
        if isinstance(answer, str):
            await connection.close(REFUSED, "the message before says why")
        elif self._draining:
            await self._send_away(connection)
        else:
            self._idle.add(connection)

    async def _send_away(self, connection: ServerConnection) -> None:
        with contextlib.suppress(ConnectionClosed):
            await connection.close(GOING_AWAY, "the server drains; connect again")
