"""WebSocket servers of sinks: all of a process share one thread with an asyncio loop.

A message is handed from the solver's thread to the loop with at most one pending wake-up, and from
there to a bounded queue for each client. A task for each client empties its queue into the socket,
hence a client that hangs delays no other.

Requests pass three checks before they are answered. A foreign ``Host`` is refused, because a page
of another name can make a browser send it here (DNS rebinding); a foreign ``Origin`` is refused,
because browsers let any page open a WebSocket to any address; and clients need a token unless only
this machine can reach the server.
"""

from __future__ import annotations

import asyncio
import hmac
import http
import ipaddress
import itertools
import json
import logging
import re
import secrets
import socket
import threading
from collections.abc import Coroutine, Iterable, Iterator
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

from locatk.core.errors import InputError, LocatkError
from locatk.core.streaming.events import PoseEstimate
from locatk.formats.extras import requires_extra
from locatk.formats.sinks.addresses import LOOPBACK, SinkAddress
from locatk.formats.sinks.interface import LiveMessage, SinkContext, SinkStatus
from locatk.formats.sinks.json_messages import finite

if TYPE_CHECKING:
    from websockets.asyncio.server import Server, ServerConnection
    from websockets.http11 import Request, Response

    Frame = str | bytes

SEND_BUFFER_BYTES = 65536
"""Size of the send buffer of a client's socket. With the default of Linux, which grows to 4 MB, a
hung client is noticed after 4 MB only, and a slow one shows poses that are seconds old."""

MAX_REQUEST_BYTES = 4096
"""Largest message of a client; those of the protocols are much smaller."""

MAX_CLIENTS = 64
"""Number of clients of a server, which bounds its memory; more get status 503."""

MAX_WAITING_EVENTS = 1000
"""Number of events other than poses that wait for a client before it is disconnected."""

MAX_HANDED_OVER = 4096
"""Number of messages that wait for the thread of the servers before older poses are dropped."""

IDLE_INTERVAL_S = 0.1
"""Time between two hand-overs while no client is connected."""

CLOSE_TIMEOUT_S = 1.0
"""Time that a client has to answer the end of its connection."""

START_TIMEOUT_S = 10.0
"""Time that opening a server may take; resolving the name of a host takes the longest."""

_LOGGER = logging.getLogger(__name__)
_LOGGER.addHandler(logging.NullHandler())
_LOGGER.propagate = False
"""Logger of the connections. It is silent: addresses of requests contain tokens."""


# ---- the thread


class _LoopThread:
    """Thread with an asyncio loop that runs while there is a server."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users = 0
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None

    def acquire(self) -> asyncio.AbstractEventLoop:
        """Return the running loop; each call needs one of :meth:`release`."""
        with self._lock:
            if self._loop is None:
                self._loop = asyncio.new_event_loop()
                self._thread = threading.Thread(
                    target=self._run, args=(self._loop,), name="locatk servers", daemon=True
                )
                self._thread.start()
            self._users += 1
            return self._loop

    def release(self) -> None:
        """End the thread if this was its last user."""
        with self._lock:
            self._users -= 1
            if self._users or self._loop is None or self._thread is None:
                return
            self._loop.call_soon_threadsafe(self._loop.stop)
            self._thread.join(CLOSE_TIMEOUT_S)
            self._loop = self._thread = None

    @staticmethod
    def _run(loop: asyncio.AbstractEventLoop) -> None:
        asyncio.set_event_loop(loop)
        try:
            loop.run_forever()
        finally:
            tasks = asyncio.all_tasks(loop)
            for task in tasks:
                task.cancel()
            with suppress(Exception):
                loop.run_until_complete(asyncio.gather(*tasks, return_exceptions=True))
            loop.close()


_THREAD = _LoopThread()


# ---- queues


@dataclass(slots=True, eq=False)
class QueuedMessage:
    """Message on its way to clients.

    Attributes
    ----------
    message : LiveMessage
    device : str or None
        Of a pose; None for other events.
    encoded : dict
        Forms in which it is sent, so that each is made once for all clients.
    """

    message: LiveMessage
    device: str | None
    encoded: dict[Any, Any] = field(default_factory=dict)


class MessageQueue:
    """Messages in their order. Beyond a limit, only the newest pose of each device is kept.

    Parameters
    ----------
    max_waiting : int
        Number of messages up to which all poses are kept; 0 to keep only the newest of each device.

    Attributes
    ----------
    replaced : int
        Number of poses that newer ones replaced.
    events : int
        Number of waiting events that are no poses. They are never dropped.
    """

    def __init__(self, max_waiting: int) -> None:
        self.replaced = 0
        self.events = 0
        self._max_waiting = max_waiting
        self._collapse_at = max_waiting
        self._items: dict[Any, QueuedMessage] = {}
        self._keys = itertools.count()

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: QueuedMessage) -> None:
        """Append a message."""
        if item.device is None:
            self.events += 1
        elif self._max_waiting == 0:
            # The names of devices and the numbers of other messages are different keys.
            self.replaced += self._items.pop(item.device, None) is not None
            self._items[item.device] = item
            return
        self._items[next(self._keys)] = item
        if self._max_waiting and len(self._items) > self._collapse_at:
            self._collapse()

    def _collapse(self) -> None:
        newest = {item.device: key for key, item in self._items.items()}
        kept = {
            key: item
            for key, item in self._items.items()
            if item.device is None or newest[item.device] == key
        }
        self.replaced += len(self._items) - len(kept)
        self._items = kept
        self._collapse_at = max(self._max_waiting, len(kept) + self._max_waiting // 2)

    def take(self) -> list[QueuedMessage]:
        """Remove and return all messages."""
        items, self._items = list(self._items.values()), {}
        self.events, self._collapse_at = 0, self._max_waiting
        return items


class Client:
    """Client of a server, with what waits for it.

    Attributes
    ----------
    connection : ServerConnection
    queue : MessageQueue
    requests : set of str
        Names of states to be sent, such as ``"health"``: each is encoded when it is sent, so that
        it is the newest one, and waits at most once.
    subscriptions : dict
        For use by the server's protocol.
    known : int
        For use by the server's protocol.
    sent : int
        Number of messages sent.
    """

    def __init__(self, connection: ServerConnection, max_waiting: int) -> None:
        self.connection = connection
        self.queue = MessageQueue(max_waiting)
        self.requests: set[str] = set()
        self.subscriptions: dict[int, Any] = {}
        self.known = 0
        self.sent = 0
        self.is_sending = True
        self._wake = asyncio.Event()

    @property
    def is_idle(self) -> bool:
        """Return whether nothing waits."""
        return not (self.is_sending or self.queue or self.requests)

    def put(self, items: Iterable[QueuedMessage]) -> None:
        """Queue messages; a client that lets too many events wait is disconnected."""
        for item in items:
            self.queue.put(item)
        if self.queue.events > MAX_WAITING_EVENTS:
            self.disconnect()
        self._wake.set()

    def request(self, name: str) -> None:
        """Queue a state."""
        self.requests.add(name)
        self._wake.set()

    def disconnect(self) -> None:
        """Close the connection without waiting for the client."""
        self.connection.transport.abort()

    async def wait(self) -> tuple[list[QueuedMessage], set[str]]:
        """Wait for messages and states, and take them out of the queue."""
        await self._wake.wait()
        self._wake.clear()
        requests, self.requests = self.requests, set()
        return self.queue.take(), requests


# ---- servers


@dataclass(frozen=True)
class Resource:
    """File that a server offers.

    Attributes
    ----------
    content_type : str
    body : bytes
    policy : str
        Content security policy.
    """

    content_type: str
    body: bytes
    policy: str = "default-src 'none'"


class ServerSink:
    """Sink that is a WebSocket server; subclasses define the protocol.

    The address may contain the option ``origin``: origins of a reverse proxy, separated by commas,
    as in ``web://:8080?origin=https://robots.example.org``. The server is then reachable from
    elsewhere, and clients need a token.

    Parameters
    ----------
    address : SinkAddress
        The server listens on the loopback interface if it has no host.

    Raises
    ------
    InputError
        The address has a path, or an unknown option.
    """

    default_port: int
    purpose: str
    """Beginning of messages about missing packages."""
    subprotocols: tuple[str, ...] = ()
    max_waiting = 0
    """Number of messages that wait for a client before older poses are dropped."""
    interval_s = 0.0
    """Least time between two hand-overs; of the poses between them only the newest is needed."""

    def __init__(self, address: SinkAddress) -> None:
        address.reject_unknown_options("origin")
        if address.path:
            example = f"{address.scheme}://:{self.default_port}"
            raise InputError(f"{address.public_text} has a path", hint=f"Example: {example}")
        self.address = address.public_text
        self.context = SinkContext("")
        self._host = address.host or LOOPBACK
        self._port = self.default_port if address.port is None else address.port
        origins = address.options.get("origin", "").split(",")
        self._origins = frozenset(each.strip().rstrip("/").lower() for each in origins) - {""}
        self._token: str | None = None
        self._clients: dict[Client, None] = {}
        self._sent = 0
        self._dropped = 0
        self._error = ""
        self._loop: asyncio.AbstractEventLoop | None = None
        self._server: Server | None = None
        self._tasks: list[asyncio.Task[None]] = []
        self._lock = threading.Lock()
        self._arrived = self._new_hand_over()
        self._is_woken = False
        self._last_s = 0.0

    # -- protocol of a subclass; all run on the thread of the servers

    def resource(self, path: str, host: str) -> Resource | None:
        """Return the file at a path, None if there is none. ``host`` is that of the request."""
        return None

    def is_socket(self, path: str) -> bool:
        """Return whether WebSockets are accepted at this path."""
        return True

    def accepts_origin(self, origin: str, has_token: bool) -> bool:
        """Return whether pages of another origin (in lower case) may connect.

        ``has_token`` is whether the request has the token, true if none is needed.
        """
        return False

    def greet(self, client: Client) -> Iterable[Frame]:
        """Return the first frames for a client."""
        return ()

    def receive(self, client: Client, text: str) -> None:
        """Take a message of a client.

        Raises
        ------
        ValueError
            It is invalid; the client is disconnected.
        """

    def observe(self, items: list[QueuedMessage]) -> None:
        """See messages before they are handed to the clients."""

    def encode(
        self, client: Client, items: list[QueuedMessage], requests: set[str]
    ) -> Iterator[Frame]:
        """Yield the frames of messages and states, and count them in ``client.sent``."""
        raise NotImplementedError

    async def run(self) -> None:
        """Do what is to be done from time to time, until cancelled."""

    # -- sink

    @property
    def url(self) -> str:
        """Address for clients, with the token."""
        raise NotImplementedError

    @property
    def token(self) -> str | None:
        """Secret that clients must present; None if none is needed."""
        return self._token

    @property
    def clients(self) -> tuple[Client, ...]:
        """Connected clients."""
        return tuple(self._clients)

    @property
    def location(self) -> str:
        """Host and port for clients: the name of this machine if all its addresses are served."""
        host = self._host
        with suppress(ValueError):
            if ipaddress.ip_address(host).is_unspecified:
                host = socket.gethostname()
        return f"[{host}]:{self._port}" if ":" in host else f"{host}:{self._port}"

    def open(self, context: SinkContext) -> None:
        """Start the server.

        Raises
        ------
        LocatkError
            The port is in use, the host is not one of this machine, or websockets is missing.
        """
        with requires_extra("live", self.purpose):
            import websockets.asyncio.server  # noqa: F401
        self.context = context
        self._token = context.token
        if self._token is None and (self._origins or not is_loopback(self._host)):
            self._token = secrets.token_urlsafe(16)
        self._loop = _THREAD.acquire()
        try:
            self._call(self._start(), START_TIMEOUT_S)
        except (OSError, TimeoutError) as error:
            self._release()
            raise self._start_error(error) from None
        except BaseException:
            self._release()
            raise

    def offer(self, message: LiveMessage) -> None:
        """Take a message; see :class:`.interface.Sink`."""
        event = message.event
        item = QueuedMessage(message, event.device if isinstance(event, PoseEstimate) else None)
        with self._lock:
            loop = self._loop
            if loop is None:
                return
            if item.device is None and self._arrived.events >= MAX_WAITING_EVENTS:
                self._dropped += 1
                return
            self._arrived.put(item)
            if self._is_woken:
                return
            self._is_woken = True
        with suppress(RuntimeError):  # The loop was closed in the meantime.
            loop.call_soon_threadsafe(self._schedule)

    def status(self) -> SinkStatus:
        """Return the counts. Poses that the protocol does not need are not counted as dropped."""
        clients = self.clients
        return SinkStatus(
            sent=self._sent + sum(client.sent for client in clients),
            dropped=self._dropped + sum(client.queue.replaced for client in clients),
            clients=len(clients),
            error=self._error,
            address=self.url.partition("#")[0].partition("?")[0],
        )

    def close(self, timeout_s: float) -> None:
        """Send what is waiting for at most ``timeout_s``, and stop."""
        if self._loop is None:
            return
        with suppress(Exception):
            self._call(self._stop(timeout_s), timeout_s + CLOSE_TIMEOUT_S)
        self._release()

    # -- the thread of the servers

    def _call(self, coroutine: Coroutine[Any, Any, None], timeout_s: float) -> None:
        """Run a coroutine on the thread of the servers."""
        assert self._loop is not None
        future: Future[None] = asyncio.run_coroutine_threadsafe(coroutine, self._loop)
        try:
            future.result(timeout_s)
        except TimeoutError:
            future.cancel()
            raise

    def _release(self) -> None:
        with self._lock:
            self._loop = None
        _THREAD.release()

    async def _start(self) -> None:
        from websockets.asyncio.server import serve
        from websockets.typing import Subprotocol

        self._server = await serve(
            self._handle,
            self._host,
            self._port,
            process_request=self._process_request,
            subprotocols=[Subprotocol(each) for each in self.subprotocols] or None,
            compression=None,
            max_size=MAX_REQUEST_BYTES,
            open_timeout=5.0,
            close_timeout=CLOSE_TIMEOUT_S,
            server_header=None,
            logger=_LOGGER,
        )
        self._port = next(iter(self._server.sockets)).getsockname()[1]
        self._tasks.append(asyncio.create_task(self._run_safely()))

    def _start_error(self, error: BaseException) -> LocatkError:
        """Return the error of a server that cannot start."""
        scheme = self.address.partition(":")[0]
        other = f"Choose another port: {scheme}://{self._host}:{self._port + 1}"
        if isinstance(error, socket.gaierror | TimeoutError):
            return LocatkError(
                f"{self.address}: unknown host {self._host}",
                hint=f"Give an address of this machine, or none: {scheme}://:{self._port}",
            )
        reason = str(getattr(error, "strerror", None) or error)
        if re.search("address already in use|10048", str(error), re.IGNORECASE):
            return LocatkError(f"{self.address}: port {self._port} is in use", hint=other)
        if re.search("permission|10013", str(error), re.IGNORECASE):
            return LocatkError(
                f"{self.address}: no permission for port {self._port}",
                hint="Choose a port from 1024",
            )
        return LocatkError(f"{self.address}: cannot listen: {reason}", hint=other)

    async def _stop(self, timeout_s: float) -> None:
        loop = asyncio.get_running_loop()
        deadline = loop.time() + timeout_s
        self._distribute()
        while loop.time() < deadline - timeout_s / 2:
            if all(client.is_idle for client in self._clients):
                break
            await asyncio.sleep(0.01)
        for task in self._tasks:
            task.cancel()
        if self._server is not None:
            self._server.close()
            with suppress(TimeoutError):
                rest_s = max(0.0, deadline - loop.time() - 0.1)
                await asyncio.wait_for(asyncio.shield(self._server.wait_closed()), rest_s)
        for client in self.clients:
            client.disconnect()
        deadline = loop.time() + CLOSE_TIMEOUT_S / 2
        while self._clients and loop.time() < deadline:
            await asyncio.sleep(0.001)

    async def _run_safely(self) -> None:
        try:
            await self.run()
        except Exception as error:
            self._error = f"{type(error).__name__}: {error}"

    def _new_hand_over(self) -> MessageQueue:
        return MessageQueue(0 if self.interval_s else MAX_HANDED_OVER)

    def _schedule(self) -> None:
        """Hand messages over now, or when the interval since the last time has passed."""
        loop = asyncio.get_running_loop()
        interval_s = self.interval_s if self._clients else max(self.interval_s, IDLE_INTERVAL_S)
        delay_s = self._last_s + interval_s - loop.time()
        if delay_s > 0:
            loop.call_later(delay_s, self._distribute)
        else:
            self._distribute()

    def _distribute(self) -> None:
        """Hand the messages that arrived to the clients."""
        with self._lock:
            items = self._arrived.take()
            if self._clients and not self.interval_s:
                self._dropped += self._arrived.replaced
            self._arrived.replaced = 0
            self._is_woken = False
        self._last_s = asyncio.get_running_loop().time()
        if not items:
            return
        try:
            self.observe(items)
        except Exception as error:
            self._error = f"{type(error).__name__}: {error}"
        for client in self.clients:
            client.put(items)

    async def _handle(self, connection: ServerConnection) -> None:
        """Serve one client until it leaves."""
        raw = connection.transport.get_extra_info("socket")
        raw.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        client = Client(connection, self.max_waiting)
        # Nothing is handed over between these two lines: the greeting is up to date.
        greeting = list(self.greet(client))
        self._clients[client] = None
        sender = asyncio.create_task(self._send(client, greeting))
        try:
            from websockets.exceptions import ConnectionClosed

            with suppress(ConnectionClosed):
                async for message in connection:
                    try:
                        self.receive(client, message if isinstance(message, str) else "")
                    except (ValueError, TypeError, KeyError, AttributeError):
                        await connection.close(1008, "invalid message")
        finally:
            sender.cancel()
            del self._clients[client]
            self._sent += client.sent
            self._dropped += client.queue.replaced + len(client.queue)

    async def _send(self, client: Client, greeting: Iterable[Frame]) -> None:
        """Send what is queued for a client until it leaves."""
        from websockets.exceptions import ConnectionClosed

        with suppress(ConnectionClosed, OSError):
            try:
                for frame in greeting:
                    await client.connection.send(frame)
                while True:
                    client.is_sending = False
                    items, requests = await client.wait()
                    client.is_sending = True
                    for frame in self.encode(client, items, requests):
                        await client.connection.send(frame)
            except ConnectionClosed:
                raise
            except Exception as error:
                self._error = f"{type(error).__name__}: {error}"
                client.disconnect()

    # -- requests

    def _process_request(self, connection: ServerConnection, request: Request) -> Response | None:
        """Check a request. Return the response, None to open a WebSocket."""
        try:
            return self._check_request(connection, request)
        except Exception as error:
            self._error = f"{type(error).__name__}: {error}"
            raise

    def _check_request(self, connection: ServerConnection, request: Request) -> Response | None:
        path, query = urlsplit(request.path).path, urlsplit(request.path).query
        host = self._checked_host(request.headers.get_all("Host"))
        if host is None:
            return _response(http.HTTPStatus.MISDIRECTED_REQUEST, "unknown Host")
        has_token = self._has_token(request, query)
        origin = request.headers.get("Origin")
        is_own = origin is None or self._is_own_origin(origin.lower(), host)
        if origin is not None and not (is_own or self.accepts_origin(origin.lower(), has_token)):
            return _response(http.HTTPStatus.FORBIDDEN, "pages of this origin have no access")
        resource = self.resource(path, host)
        if resource is not None:
            response = _response(http.HTTPStatus.OK, resource.body, resource.content_type)
            response.headers["Content-Security-Policy"] = resource.policy
            return response
        is_health = path == "/health"
        if not (is_health or self.is_socket(path)):
            return _response(http.HTTPStatus.NOT_FOUND, "not found")
        # Requests through a reverse proxy come from this machine, too.
        is_local = not self._origins and is_loopback(connection.remote_address[0])
        if not has_token and not (is_health and is_local):
            return _response(http.HTTPStatus.UNAUTHORIZED, "the token is missing or wrong")
        if is_health:
            health = self.health()
            is_ok = health.get("ok") is True
            status = http.HTTPStatus.OK if is_ok else http.HTTPStatus.SERVICE_UNAVAILABLE
            return _response(status, to_json_text(health), "application/json")
        if len(self._clients) >= MAX_CLIENTS:
            return _response(http.HTTPStatus.SERVICE_UNAVAILABLE, "too many clients")
        return None

    def health(self) -> dict[str, Any]:
        """Return the health of the session."""
        try:
            return dict(self.context.status())
        except Exception as error:
            return {"ok": False, "error": f"{type(error).__name__}: {error}"}

    def _checked_host(self, headers: list[str]) -> str | None:
        """Return the host and port that a request is for; None if it is not for this server."""
        host = headers[0].lower() if len(headers) == 1 else ""
        match = re.fullmatch(r"(\[[0-9a-f:.]+\]|[a-z0-9.-]+)(:\d{1,5})?", host)
        if match is None:
            return None
        name = match[1].strip("[]")
        if is_loopback(name) or any(urlsplit(origin).netloc == host for origin in self._origins):
            return host
        if is_loopback(self._host):
            return None
        # A page can let a browser take a name of its own for this server's, but no address.
        names = {self._host.lower(), socket.gethostname().lower()}
        is_own = name in names or name.removesuffix(".local") in names or _is_ip_address(name)
        return host if is_own else None

    def _is_own_origin(self, origin: str, host: str) -> bool:
        """Return whether a page is of this server, or of its reverse proxy."""
        return origin in (f"http://{host}", f"https://{host}") or origin in self._origins

    def _has_token(self, request: Request, query: str) -> bool:
        """Return whether a request contains the token, or none is needed."""
        if self._token is None:
            return True
        given = parse_qs(query).get("token", [""])[-1]
        scheme, _, credentials = request.headers.get("Authorization", "").partition(" ")
        if scheme.lower() == "bearer":
            given = credentials
        return hmac.compare_digest(given.encode(), self._token.encode())


def to_json_text(value: Any) -> str:
    """Return a value as JSON; numbers that are not finite become null, other objects their text."""
    try:
        return json.dumps(value, allow_nan=False, separators=(",", ":"), default=str)
    except ValueError:
        return json.dumps(finite(value), separators=(",", ":"), default=str)


def _response(
    status: http.HTTPStatus, body: str | bytes, content_type: str = "text/plain; charset=utf-8"
) -> Response:
    from websockets.datastructures import Headers
    from websockets.http11 import Response

    data = body.encode() if isinstance(body, str) else body
    headers = Headers(
        {
            "Content-Type": content_type,
            "Content-Length": str(len(data)),
            "Cache-Control": "no-store",
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
            "Cross-Origin-Resource-Policy": "same-origin",
            "Connection": "close",
        }
    )
    return Response(status.value, status.phrase, headers, data)


def _is_ip_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach an address."""
    if host.lower() == "localhost":
        return True
    return _is_ip_address(host) and ipaddress.ip_address(host).is_loopback
