"""Runs on a page that is served on loopback, with a random token in its address: made from the stores alone."""

import json
import secrets
import threading
import time
from collections.abc import Callable, Iterable
from socketserver import ThreadingMixIn
from typing import Any
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from linksweep.sweep.analysis.quantity import with_running
from linksweep.sweep.contract import SweepError
from linksweep.sweep.report.page import Picture, drawn, policy, template, template_file
from linksweep.sweep.running.status import SHARE, Tile, Watched, pause
from linksweep.sweep.stores.location import Where
from linksweep.sweep.stores.store import is_new

MOST_TILES = 2000

# The most of a core that drawing takes of a study of few points; of more, it takes no more than looking.
FIGURE_SHARE, FEW_POINTS = 0.1, 10_000

# Names by which a browser asks; under any other, a page of others may have sent it here.
HOSTS = ("127.0.0.1", "localhost")

HEADERS = [("Cache-Control", "no-store"), ("Referrer-Policy", "no-referrer"), ("X-Content-Type-Options", "nosniff")]


class Shown:
    """A store as the page shows it: its ``tiles``, and its ``figure``, drawn again for new results."""

    def __init__(self, where: Where) -> None:
        """Look at nothing yet."""
        self.watched, self.figure = Watched(where), Picture("")
        self.tiles: list[list[Tile]] = []
        self._drawn: Any = None
        self._redraw = 0.0

    def look(self) -> None:
        """Look at the store."""
        self.watched.look()
        self.tiles = self.watched.tiles(MOST_TILES, MOST_TILES)

    def draw(self) -> bool:
        """Draw its results if they are new and it is time; return whether they were."""
        opened = self.watched.opened
        waits = not self.watched.is_over and time.monotonic() < self._redraw
        if opened is None or is_new(opened.root) or opened.root is self._drawn or waits:
            return False
        begun = time.process_time()
        try:
            dataset = with_running(opened.dataset(running=True)).assign_attrs(title="")
            self.figure = drawn(dataset, "", f"watch-{self.watched.location}")
        except SweepError as error:
            self.figure = Picture("", problem="; ".join(error.problems))
        share = FIGURE_SHARE if self.watched.status.size <= FEW_POINTS else SHARE
        took = time.process_time() - begun if self.figure.svg else 0.0
        self._drawn, self._redraw = opened.root, time.monotonic() + took / share
        return bool(self.figure.svg)


class Page:
    """The page about some stores, which are looked at when somebody asks, at most every ``interval`` seconds."""

    def __init__(self, stores: Iterable[Where], interval: float) -> None:
        """Look at nothing yet."""
        self._stores, self._interval = list(map(Shown, stores)), interval
        self._lock, self._next, self._state = threading.Lock(), 0.0, ""
        page, scripts = template("watch.html.j2"), list(map(template_file, ("page.js", "watch.js")))
        about = {"style": "\n".join(map(template_file, ("page.css", "watch.css"))), "interval": 1000 * interval}
        self._whole, self._macros = page.render(stores=self._stores, scripts=scripts, **about), page.module
        self.token = secrets.token_urlsafe(24)
        self._policy = f"{policy(scripts)}; connect-src 'self'; frame-ancestors 'none'"

    def __call__(self, request: Any, start: Callable[..., Any]) -> list[bytes]:
        """Answer a request, as WSGI has it."""
        known = {f"/{self.token}/": "text/html", f"/{self.token}/state": "application/json"}
        is_ours = request.get("HTTP_HOST", "").partition(":")[0] in HOSTS
        kind = known.get(request["PATH_INFO"]) if is_ours and request["REQUEST_METHOD"] == "GET" else None
        about = [("Content-Type", f"{kind or 'text/plain'}; charset=utf-8"), ("Content-Security-Policy", self._policy)]
        start("200 OK" if kind else "404 Not Found" if is_ours else "403 Forbidden", HEADERS + about)
        text = self._seen() if kind == "application/json" else self._whole if kind else ""
        return [text.encode(errors="replace")]

    def _seen(self) -> str:
        with self._lock:
            if time.monotonic() >= self._next:
                begun = time.process_time()
                for one in self._stores:
                    one.look()
                parts = self._parts("head", "tiles", "failures")
                # The first look makes the points, which it need not do again.
                took = time.process_time() - begun if self._state else 0.0
                self._next = time.monotonic() + pause(self._interval, took)
                # Not before the first answer, and then one at a time: tiles do not wait for figures.
                any(one.draw() for one in self._stores if self._state)
                self._state = json.dumps(parts | self._parts("figure"))
            return self._state

    def _parts(self, *names: str) -> dict[str, str]:
        return {f"{n}-{i}": str(getattr(self._macros, n)(one)) for i, one in enumerate(self._stores) for n in names}


class _Handler(WSGIRequestHandler):
    def log_message(self, *_message: Any) -> None:
        return


class _Server(ThreadingMixIn, WSGIServer):
    daemon_threads = True

    def handle_error(self, *_request: Any) -> None:
        return  # browsers leave, or open connections that they do not use


def serve(stores: Iterable[Where], interval: float, said: Callable[[str], None]) -> None:
    """Serve a page about stores until an interruption; ``said`` is called with its address."""
    page = Page(stores, interval)
    with make_server("127.0.0.1", 0, page, _Server, _Handler) as server:
        said(f"http://127.0.0.1:{server.server_port}/{page.token}/")
        server.serve_forever()
