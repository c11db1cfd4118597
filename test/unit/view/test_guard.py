"""Who may use the pages: requests of themselves only, and with a token."""

from __future__ import annotations

import asyncio

import pytest

from calib_ros.errors import BadInputError
from calib_ros_view.web.server import COOKIE, LOCAL_NAMES, Address, Guard, listening

NAMES = frozenset(LOCAL_NAMES)


def ask(guard, kind="http", query="", **headers):
    """Status of an answer, or the code with which a socket is closed; 0 if the application was reached by a socket."""
    sent = []

    async def receive():
        return {"type": "websocket.connect"}

    async def send(message):
        sent.append(message)

    raw = [(name.replace("_", "-").encode(), value.encode()) for name, value in headers.items()]
    scope = {"type": kind, "headers": raw, "query_string": query.encode()}
    asyncio.run(guard(scope, receive, send))
    return sent[0].get("status", sent[0].get("code", 0)), dict(sent[0].get("headers", ()))


async def app(scope, receive, send):
    if scope["type"] == "http":
        await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "websocket.accept"})


@pytest.mark.parametrize("kind", ["http", "websocket"])
def test_only_the_pages_themselves_are_answered(kind):
    guard = Guard(app, NAMES, None)
    ok, no = (200, 403) if kind == "http" else (0, 4403)
    assert ask(guard, kind, host="127.0.0.1:8765")[0] == ok
    assert ask(guard, kind, host="localhost:8765", origin="http://localhost:8765")[0] == ok
    assert ask(guard, kind, host="[::1]:8765", origin="http://[::1]:8765")[0] == ok
    for origin in ("http://evil.example", "http://localhost:9999", "null", "http://localhost", "http://[", "["):
        assert ask(guard, kind, host="localhost:8765", origin=origin)[0] == no, origin
    for host in ("evil.example:8765", "127.0.0.1.evil.example", "", "[", "[::1"):
        assert ask(guard, kind, host=host, origin=f"http://{host}")[0] == no, host
    assert ask(guard, kind)[0] == no


@pytest.mark.parametrize("kind", ["http", "websocket"])
def test_a_token_is_asked_for_and_kept_in_a_cookie(kind):
    guard = Guard(app, None, "secret")
    ok, no = (200, 403) if kind == "http" else (0, 4403)
    assert ask(guard, kind, host="car:8765")[0] == no
    assert ask(guard, kind, "token=wrong", host="car:8765")[0] == no
    assert ask(guard, kind, "token=", host="car:8765")[0] == no
    assert ask(guard, kind, host="car:8765", cookie=f"{COOKIE}_8765=wrong")[0] == no
    status, headers = ask(guard, kind, "token=secret", host="car:8765")
    assert status == ok
    if kind == "http":
        assert headers[b"set-cookie"].startswith(f"{COOKIE}_8765=secret; ".encode())
        assert b"HttpOnly; SameSite=Strict" in headers[b"set-cookie"]
    assert ask(guard, kind, host="car:8765", cookie=f"a=b; {COOKIE}_8765=secret")[0] == ok
    assert ask(guard, kind, host="car:8765", cookie=f"{COOKIE}_8765=secret", origin="http://evil.example")[0] == no
    # Another server on the same host has a token of its own, and browsers send it along.
    assert ask(guard, kind, host="car:8765", cookie=f"{COOKIE}_8766=other; {COOKIE}_8765=secret")[0] == ok
    assert ask(guard, kind, host="car:8766", cookie=f"{COOKIE}_8765=secret")[0] == no
    for other in ('prefs={"theme":"dark"}', "x=a b", "a;;b", "name=\xfc"):  # of other pages on this host
        assert ask(guard, kind, host="car:8765", cookie=f"{other}; {COOKIE}_8765=secret")[0] == ok
        assert ask(guard, kind, host="car:8765", cookie=f"{COOKIE}_8765=secret; {other}")[0] == ok
    assert ask(guard, kind, "token=secret", host="car:99999")[0] == no


@pytest.mark.parametrize(("host", "local"), [("127.0.0.1", True), ("localhost", True), ("::1", True), ("0.0.0.0", False)])
def test_which_addresses_are_of_this_machine_only(host, local):
    assert Address(host).is_local is local


def test_what_cannot_be_an_address_is_a_clear_error():
    with pytest.raises(BadInputError, match="cannot listen"):
        listening(Address(port=70_000))
    assert Address("::1", 1).url(2, "t") == "http://[::1]:2/?token=t"
    for token in ("", "a b", "a;b", "a&b", "a\nSet-Cookie: x", "schlüssel"):  # no address or cookie can hold it
        with pytest.raises(BadInputError, match="--token"):
            Address(token=token)
