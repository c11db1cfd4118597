"""The web server of the pages: one address, who may use it, and a clean end.

A page is a function that is called for every browser that opens it, and lays it out with NiceGUI. Pictures come from routes of
their own. Everything, the socket too, passes `Guard` first.
"""

from __future__ import annotations

import hmac
import ipaddress
import itertools
import re
import secrets
import socket
import threading
from collections import OrderedDict
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

from calib_ros.errors import BadInputError, CalibrationError, MissingDependencyError
from calib_ros_view.session.live import Pair

if TYPE_CHECKING:
    from fastapi import FastAPI

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

PORT = 8765
LOCAL_NAMES = ("localhost", "127.0.0.1", "::1")
COOKIE = "calib_ros_token"  # and the port: browsers do not tell apart the cookies of two servers of one host
TOKEN_BYTES = 16
TOKEN = re.compile(r"[A-Za-z0-9._-]+")
REFUSED_ORIGIN = b"refused: this request comes from another page; open the address that calib-ros printed"
REFUSED_TOKEN = b"refused: open the whole address that calib-ros printed, with its token"
PICTURES_HELD = 256  # of all browsers together
RIG = "/"  # address of the page of all sensors
Opened = tuple[Callable[[], None], Callable[[], None]]  # builds the page for a browser; ends what runs for it
Opening = Callable[[str, str], Opened]  # of a camera and a LiDAR
PAGE_S = 300.0  # in which the frames of a pair are read and searched for edges
FINISH_S = 2  # seconds that open connections get at the end


@dataclass(frozen=True)
class Address:
    """Where the pages are served. port: 0 = any free one. token: None = none on this machine, else a random one.

    BadInputError for a token that an address or a cookie cannot hold as it is.
    """

    host: str = "127.0.0.1"
    port: int = PORT
    token: str | None = None

    def __post_init__(self) -> None:
        if self.token is not None and not TOKEN.fullmatch(self.token):
            raise BadInputError("--token may hold letters, digits, '-', '.' and '_', one at least; they stand in the address")

    @property
    def is_local(self) -> bool:
        """Whether only programs of this machine reach it."""
        try:
            return ipaddress.ip_address(self.host).is_loopback
        except ValueError:
            return self.host == "localhost"

    def url(self, port: int, token: str | None) -> str:
        """What people open."""
        host = self.host if self.host not in ("0.0.0.0", "::") else socket.gethostname()
        host = f"[{host}]" if ":" in host else host
        return f"http://{host}:{port}/" + (f"?token={token}" if token else "")


class Guard:
    """Lets through only requests of the pages themselves, and with a token only of those who have it.

    A page of somebody else's that is open in the same browser may send requests to this machine too: those carry the `Origin` of
    that page, or, by a name that was made to point here, its `Host`. names: under which this server may be addressed; None = any,
    which a token must then make up for.
    """

    def __init__(self, app: App, names: frozenset[str] | None, token: str | None) -> None:
        self._app, self._names, self._token = app, names, token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """An ASGI application."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
            return
        headers = {name.decode("latin-1").lower(): value.decode("latin-1") for name, value in scope["headers"]}
        if not self._own_page(headers):
            await _refuse(scope, receive, send, REFUSED_ORIGIN)
            return
        # Of the port that the browser addresses, which behind a tunnel is not the one that is served. SimpleCookie would drop all
        # for one that it cannot parse, as other pages of a host may set.
        name = f"{COOKIE}_{urlsplit('//' + headers.get('host', '')).port or 80}"
        pairs = (part.strip().partition("=") for part in headers.get("cookie", "").split(";"))
        held = next((value for own, _, value in pairs if own == name), "")
        asked = parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [""])[0]
        if self._token is None or hmac.compare_digest(held.encode(), self._token.encode()):
            await self._app(scope, receive, send)
        elif hmac.compare_digest(asked.encode(), self._token.encode()):
            await self._app(scope, receive, self._with_cookie(send, name))
        else:
            await _refuse(scope, receive, send, REFUSED_TOKEN)

    def _own_page(self, headers: Mapping[str, str]) -> bool:
        host, origin = headers.get("host", ""), headers.get("origin")
        try:
            own = urlsplit(f"//{host}")
            name, _ = own.hostname or "", own.port
            return (self._names is None or name in self._names) and (origin is None or urlsplit(origin).netloc == host)
        except ValueError:  # no address at all, as "[", or no port, as ":99999"
            return False

    def _with_cookie(self, send: Send, name: str) -> Send:
        cookie = f"{name}={self._token}; Path=/; HttpOnly; SameSite=Strict".encode("latin-1")

        async def sent(message: MutableMapping[str, Any]) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", ()), (b"set-cookie", cookie), (b"referrer-policy", b"no-referrer")]
            await send(message)

        return sent


async def _refuse(scope: Scope, receive: Receive, send: Send, why: bytes) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": 4403})
        return
    await send({"type": "http.response.start", "status": 403, "headers": [(b"content-type", b"text/plain; charset=utf-8")]})
    await send({"type": "http.response.body", "body": why})


def listening(address: Address) -> socket.socket:
    """A socket that listens there. BadInputError if the port is taken, or the host is not one of this machine's."""
    family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
    made = socket.socket(family, socket.SOCK_STREAM)
    made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        made.bind((address.host, address.port))
        made.listen(64)
    except (OSError, OverflowError) as error:
        made.close()
        raise BadInputError(
            f"cannot listen on {address.host} port {address.port}: {error}; choose another --port (0 = any free one) or --host"
        ) from None
    return made


class Pictures:
    """The last picture of each name, in memory: no request names a file."""

    def __init__(self) -> None:
        self._held: OrderedDict[str, tuple[bytes, str]] = OrderedDict()  # with its address
        self._count = itertools.count()
        self._lock = threading.Lock()

    def put(self, name: str, data: bytes) -> str:
        """Hold a JPEG under a name in place of the one before; returns its address, another one whenever it is another."""
        name = name.replace("/", " ")
        with self._lock:
            if name not in self._held or self._held[name][0] is not data:
                self._held[name] = data, f"/picture/{name}?v={next(self._count)}"
            self._held.move_to_end(name)
            while len(self._held) > PICTURES_HELD:
                self._held.popitem(last=False)
            return self._held[name][1]

    def drop(self, owner: str) -> None:
        """Forget the pictures of a browser that has left, whose names begin with its own."""
        with self._lock:
            for name in [name for name in self._held if name.startswith(owner)]:
                del self._held[name]

    def routes(self, app: FastAPI) -> None:
        """Add the address of the pictures."""
        from fastapi import Response

        @app.get("/picture/{name}", response_class=Response)
        def picture(name: str):  # type: ignore[no-untyped-def]  # FastAPI resolves annotations, which are imported late here
            data, _ = self._held.get(name, (b"", ""))
            return Response(data, 200 if data else 404, {"Cache-Control": "no-store"}, "image/jpeg")


def require_nicegui() -> None:
    """MissingDependencyError, before any work is done in vain."""
    try:
        import nicegui  # noqa: F401
    except ImportError as error:
        raise MissingDependencyError(f"pages need {error.name}: python3 -m pip install 'calib_ros[view]'") from None


def serve(
    page: Callable[[], None],
    title: str,
    address: Address,
    pictures: Pictures,
    ready: Callable[[str], None],
    opening: Opening | None = None,
) -> None:
    """Serve a page until Ctrl-C or SIGTERM.

    ready: called with the address to open, once it can be. opening: makes the page of a pair of a rig when it is opened first, of
    which all browsers see the same; CalibrationError where there is none. Raises BadInputError if the address cannot be used.
    """
    import uvicorn
    from fastapi import FastAPI
    from nicegui import run, ui

    taken = listening(address)
    token = address.token or (None if address.is_local else secrets.token_urlsafe(TOKEN_BYTES))
    port = taken.getsockname()[1]
    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    pictures.routes(app)
    ui.page("/", title=title)(page)
    opened: dict[Pair, Opened] = {}
    one_at_a_time = threading.Lock()

    def open_pair(pair: Pair) -> Opened:
        assert opening is not None
        with one_at_a_time:
            if pair not in opened:
                opened[pair] = opening(*pair)
            return opened[pair]

    async def pair_page(camera: str, lidar: str) -> None:
        try:
            found = await run.io_bound(open_pair, (camera, lidar))
        except CalibrationError as error:
            from calib_ros_view.web import theme

            with theme.bar(f"{camera} with {lidar}", {}, RIG):
                ui.space()
            ui.label(str(error)).classes("p-4").props("role=alert")
            return
        if found is not None:  # else the server ends
            found[0]()

    if opening is not None:
        ui.page("/pair/{camera}/{lidar}", title=title, response_timeout=PAGE_S)(pair_page)
    # Undelivered messages hold pictures of the past: few are kept.
    ui.run_with(app, title=title, dark=None, message_history_length=50, show_welcome_message=False)
    names = frozenset(LOCAL_NAMES) if address.is_local else None
    guarded: Any = Guard(app, names, token)
    config = uvicorn.Config(guarded, log_level="warning", access_log=False, timeout_graceful_shutdown=FINISH_S)

    class Server(uvicorn.Server):
        async def startup(self, sockets: list[socket.socket] | None = None) -> None:
            """Tell the address only when Ctrl-C ends the server properly."""
            await super().startup(sockets)
            ready(address.url(port, token))

    try:
        Server(config).run(sockets=[taken])
    except KeyboardInterrupt:  # uvicorn ends properly, and raises the signal again
        pass
    finally:
        for _, end in opened.values():
            end()
