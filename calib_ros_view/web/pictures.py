"""Pictures that browsers fetch."""

from __future__ import annotations

import itertools
import threading
from collections import OrderedDict
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fastapi import FastAPI

PICTURES_HELD = 128  # of all browsers together


class Pictures:
    """The last picture of each name, in memory: no request names a file."""

    def __init__(self) -> None:
        self._held: OrderedDict[str, bytes] = OrderedDict()
        self._count = itertools.count()
        self._lock = threading.Lock()

    def put(self, name: str, data: bytes) -> str:
        """Hold a JPEG under a name in place of the one before; returns its address, another one every time."""
        with self._lock:
            self._held[name] = data
            self._held.move_to_end(name)
            while len(self._held) > PICTURES_HELD:
                self._held.popitem(last=False)
        return f"/picture/{name}?v={next(self._count)}"

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
            data = self._held.get(name)
            return Response(data or b"", 200 if data else 404, {"Cache-Control": "no-store"}, "image/jpeg")
