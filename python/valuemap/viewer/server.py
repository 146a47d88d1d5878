"""A server for one page on this machine: it answers that page and nobody else.

Another web page that is open in the same browser can send requests to 127.0.0.1, and a name in its control can be made
to mean 127.0.0.1. So every request must name this server as its Host, come from this server's own page (Origin and
Sec-Fetch-Site, where a browser sends them) and carry the token of this run, which is in the address that
`valuemap view` opens. No path of a request ever becomes a path of a file: the files of the page are listed once, and
pictures are found by the id of their image and only inside the folder of pictures.
"""

from __future__ import annotations

import hmac
import json
import math
import secrets
import sys
import threading
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np

from valuemap.errors import InputError, OutputError, ValuemapError
from valuemap.evidence import picture_file
from valuemap.map_folder import MARKER, REVIEW
from valuemap.viewer.crops import crop_jpeg, whole_jpeg
from valuemap.viewer.details import label_details, place_details
from valuemap.viewer.opinions import Opinions
from valuemap.viewer.scene import Scene

PAGE = Path(__file__).parent / "page"
HOST = "127.0.0.1"

_LARGEST_BODY = 64 * 1024
_LARGEST_COORDINATE = 1e7
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    ".json": "application/json",
    ".txt": "text/plain; charset=utf-8",
}


@dataclass(frozen=True)
class Basemap:
    """What lies under the labels: a style that the browser fetches from elsewhere, or tiles in a file here."""

    style_url: str | None = None
    tiles: Path | None = None

    def to_json(self) -> dict[str, str]:
        """Return what the page needs to know."""
        return {"style": self.style_url} if self.style_url is not None else {"tiles": "/basemap.pmtiles"}

    @classmethod
    def from_text(cls, text: str) -> Basemap:
        """Return what --basemap names.

        Raises
        ------
        InputError
            It is neither an https address nor a .pmtiles file.
        """
        if text.startswith(("https://", "http://")):
            return cls(style_url=text)
        path = Path(text)
        if path.suffix.lower() == ".pmtiles" and path.is_file():
            return cls(tiles=path)
        raise InputError(
            f"--basemap {text}: is neither a file that ends in .pmtiles nor the address of a style",
            hint="cut a region out with `pmtiles extract`, or give https://.../style.json",
        )


class Content:
    """The scene and the decisions about it, read anew when the map was made again.

    Raises
    ------
    ValuemapError
        The map cannot be shown.
    """

    def __init__(self, read_scene: Callable[[], Scene], review: Path | None) -> None:
        self._read_scene = read_scene
        self._review = review
        self._lock = threading.Lock()
        self.scene = read_scene()
        self.opinions = self._read_opinions()
        self._version = self._stamp()
        _ = self.scene.labels_body, self.scene.cameras_body  # What a page waits for when it opens.
        threading.Thread(target=_warm_up, args=(self.scene,), daemon=True).start()

    def _read_opinions(self) -> Opinions:
        return Opinions(self.scene, self._review or self.scene.folder / REVIEW)

    def _stamp(self) -> tuple[int, int]:
        try:
            found = (self.scene.folder / MARKER).stat()
        except OSError:
            return (0, 0)
        return found.st_mtime_ns, found.st_ino

    def refresh(self) -> None:
        """Read the map again if it was made again."""
        with self._lock:
            version = self._stamp()
            if version in (self._version, (0, 0)):
                return
            self.scene = self._read_scene()
            self.opinions = self._read_opinions()
            self._version = version


def _warm_up(scene: Scene) -> None:
    """Answer a click that nobody made: what all clicks need is computed then, and the first one need not wait."""
    labels = scene.result.labels
    if len(labels):
        label_details(scene, int(labels.label_id[0]))
        east, north, _ = scene.local(labels.position_in_world_m[:1])[0]
        place_details(scene, float(east), float(north))


@dataclass(frozen=True)
class _Answer:
    """Body and kind of an answer, with status and further headers."""

    body: bytes
    kind: str
    status: HTTPStatus = HTTPStatus.OK
    headers: tuple[tuple[str, str], ...] = (("Cache-Control", "no-store"),)


class _Refused(Exception):
    """A request that is not answered; the text says why."""

    def __init__(self, status: HTTPStatus, reason: str) -> None:
        super().__init__(reason)
        self.status = status


class ViewServer(ThreadingHTTPServer):
    """Serves one map to one page until it is shut down.

    Parameters
    ----------
    content
        What to show.
    port
        Port on 127.0.0.1, 0 for a free one.
    basemap
        What to draw under the labels.
    """

    daemon_threads = True
    request_queue_size = 64

    def __init__(self, content: Content, *, port: int = 0, basemap: Basemap | None = None) -> None:
        self.content = content
        self.basemap = basemap
        self.token = secrets.token_urlsafe(24)
        self.pages = {f"/{path.relative_to(PAGE).as_posix()}": path for path in PAGE.rglob("*") if path.is_file()}
        if "/index.html" not in self.pages:
            raise OutputError(f"{PAGE}: the page is not built", hint="run `npm ci && npm run build` in viewer/")
        try:
            super().__init__((HOST, port), _Handler)
        except OSError as error:
            raise OutputError(
                f"port {port} of {HOST} cannot be used: {error.strerror or error}", hint="choose another --port"
            ) from error

    @property
    def port(self) -> int:
        """The port that it listens on."""
        return int(self.server_address[1])

    @property
    def address(self) -> str:
        """The address to open, with the token."""
        return f"http://{HOST}:{self.port}/?token={self.token}"

    @property
    def hosts(self) -> tuple[str, str]:
        """What a request may name as its Host."""
        return f"{HOST}:{self.port}", f"localhost:{self.port}"

    @property
    def cookie(self) -> str:
        """Cookies do not tell ports apart, so the name does."""
        return f"valuemap-{self.port}"

    def policy(self) -> str:
        """Return the content security policy: nothing from elsewhere, unless the user gave a style from elsewhere."""
        elsewhere = ""
        if self.basemap is not None and self.basemap.style_url is not None:
            elsewhere = " https:" if self.basemap.style_url.startswith("https:") else " https: http:"
        return "; ".join(
            (
                "default-src 'none'",
                "script-src 'self'",
                "worker-src 'self'",
                "style-src 'self'",
                f"img-src 'self' blob: data:{elsewhere}",
                f"connect-src 'self'{elsewhere}",
                "base-uri 'none'",
                "form-action 'none'",
                "frame-ancestors 'none'",
            )
        )

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing where a browser hung up; everything else is a fault of ours."""
        if not isinstance(sys.exc_info()[1], ConnectionError | TimeoutError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: ViewServer
    protocol_version = "HTTP/1.1"
    server_version = "valuemap"
    sys_version = ""
    timeout = 60.0

    def do_GET(self) -> None:
        self._respond(self._get)

    def do_HEAD(self) -> None:
        self._respond(self._get)

    def do_POST(self) -> None:
        self._respond(self._post)

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002
        """Print nothing: who reads a map wants no log of requests."""

    def _respond(self, answer: Callable[[str, dict[str, str]], _Answer]) -> None:
        try:
            self._check_sender()
            url = urlsplit(self.path)
            query = {name: values[-1] for name, values in parse_qs(url.query, keep_blank_values=True).items()}
            self._check_token(url.path, query)
            reply = answer(url.path, query)
        except _Refused as refusal:
            reply = _problem(refusal.status, str(refusal))
        except InputError as error:
            reply = _problem(HTTPStatus.NOT_FOUND, str(error))
        except ValuemapError as error:
            reply = _problem(HTTPStatus.INTERNAL_SERVER_ERROR, str(error))
        except ConnectionError:
            raise
        except Exception:  # The page must hear of it, and so must we.
            traceback.print_exc()
            reply = _problem(HTTPStatus.INTERNAL_SERVER_ERROR, "a fault of the server: its terminal says more")
        self._send(reply)

    def _send(self, reply: _Answer) -> None:
        self.send_response(reply.status)
        self.send_header("Content-Type", reply.kind)
        self.send_header("Content-Length", str(len(reply.body)))
        self.send_header("Content-Security-Policy", self.server.policy())
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("X-Frame-Options", "DENY")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("Cross-Origin-Resource-Policy", "same-origin")
        self.send_header("Cross-Origin-Opener-Policy", "same-origin")
        for name, value in reply.headers:
            self.send_header(name, value)
        if reply.status >= HTTPStatus.BAD_REQUEST:  # What is left of a refused request is not read.
            self.send_header("Connection", "close")
            self.close_connection = True
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(reply.body)

    # Who asks

    def _check_sender(self) -> None:
        hosts = self.headers.get_all("Host") or []
        if len(hosts) != 1 or hosts[0] not in self.server.hosts:
            raise _Refused(HTTPStatus.FORBIDDEN, "this server answers to its own address only (Host)")
        origin = self.headers.get("Origin")
        if origin is not None and origin != f"http://{hosts[0]}":
            raise _Refused(HTTPStatus.FORBIDDEN, "this server answers to its own page only (Origin)")
        site = self.headers.get("Sec-Fetch-Site", "none")
        if site not in ("none", "same-origin") and self.headers.get("Sec-Fetch-Mode") != "navigate":
            raise _Refused(HTTPStatus.FORBIDDEN, "this server answers to its own page only (Sec-Fetch-Site)")
        if self.command == "POST" and origin is None:
            raise _Refused(HTTPStatus.FORBIDDEN, "changes come from this server's own page only (Origin)")

    def _check_token(self, path: str, query: dict[str, str]) -> None:
        given = query.get("token", "") if path == "/" else ""
        if not given:
            try:
                found = SimpleCookie(self.headers.get("Cookie", "")).get(self.server.cookie)
            except CookieError:
                found = None
            given = "" if found is None else found.value
        if not hmac.compare_digest(given.encode(), self.server.token.encode()):
            raise _Refused(HTTPStatus.UNAUTHORIZED, "open the address that valuemap view printed: it holds the token")

    # What is asked

    def _get(self, path: str, query: dict[str, str]) -> _Answer:
        content = self.server.content
        if path == "/":
            content.refresh()  # Before the page asks for anything: what it asks for at once must be of one map.
            return self._page()
        if path in self.server.pages:
            return _file(self.server.pages[path])
        if path == "/basemap.pmtiles":
            return self._tiles()
        if path == "/api/map":
            content.refresh()
            basemap = self.server.basemap
            return _json(content.scene.head() | {"basemap": None if basemap is None else basemap.to_json()})
        scene = content.scene
        bodies: dict[str, Callable[[], bytes]] = {
            "/api/labels": lambda: scene.labels_body,
            "/api/cameras": lambda: scene.cameras_body,
            "/api/truth": lambda: scene.truth_body,
            "/api/rejected": lambda: scene.rejected_body,
        }
        if path in bodies:
            return _Answer(bodies[path](), "application/octet-stream")
        if path == "/api/reviews":
            return _json(content.opinions.to_json())
        if path == "/api/label":
            return _json(label_details(scene, _whole(query, "id")))
        if path == "/api/place":
            return _json(place_details(scene, _coordinate(query, "east"), _coordinate(query, "north")))
        if path == "/api/crop":
            picture = _picture(scene, query)
            place = (_coordinate(query, "x"), _coordinate(query, "y"), _coordinate(query, "side"))
            return _picture_answer(crop_jpeg(picture, picture.stat().st_mtime_ns, *place))
        if path == "/api/picture":
            picture = _picture(scene, query)
            return _picture_answer(whole_jpeg(picture, picture.stat().st_mtime_ns))
        raise _Refused(HTTPStatus.NOT_FOUND, "there is nothing here")

    def _post(self, path: str, query: dict[str, str]) -> _Answer:
        if path != "/api/reviews" or query:
            raise _Refused(HTTPStatus.NOT_FOUND, "there is nothing here")
        if self.headers.get_content_type() != "application/json":
            raise _Refused(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "expected JSON")
        try:
            length = int(self.headers.get("Content-Length", ""))
        except ValueError:
            raise _Refused(HTTPStatus.LENGTH_REQUIRED, "expected a Content-Length") from None
        if not 0 < length <= _LARGEST_BODY:
            raise _Refused(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"expected 1 to {_LARGEST_BODY} bytes")
        try:
            wish = json.loads(self.rfile.read(length))
        except (ValueError, RecursionError):
            raise _Refused(HTTPStatus.BAD_REQUEST, "expected JSON") from None
        try:
            return _json(self.server.content.opinions.decide(wish))
        except InputError as error:
            raise _Refused(HTTPStatus.BAD_REQUEST, str(error)) from None

    def _page(self) -> _Answer:
        cookie = f"{self.server.cookie}={self.server.token}; Path=/; HttpOnly; SameSite=Strict"
        body = self.server.pages["/index.html"].read_bytes()
        return _Answer(body, _TYPES[".html"], headers=(("Cache-Control", "no-store"), ("Set-Cookie", cookie)))

    def _tiles(self) -> _Answer:
        """Return the part of the tiles that is asked for: PMTiles are read in ranges."""
        basemap = self.server.basemap
        if basemap is None or basemap.tiles is None:
            raise _Refused(HTTPStatus.NOT_FOUND, "there is no basemap")
        size = basemap.tiles.stat().st_size
        unit, _, span = self.headers.get("Range", "").partition("=")
        first, _, last = span.partition("-")
        if unit != "bytes" or not first.isdecimal() or not (last.isdecimal() or not last) or int(first) >= size:
            raise _Refused(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, f"expected a range of {size} bytes")
        start, end = int(first), min(int(last) if last else size - 1, size - 1)
        if end < start:
            raise _Refused(HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE, f"expected a range of {size} bytes")
        with basemap.tiles.open("rb") as file:
            file.seek(start)
            body = file.read(end - start + 1)
        headers = (("Content-Range", f"bytes {start}-{end}/{size}"), ("Accept-Ranges", "bytes"))
        return _Answer(body, "application/octet-stream", HTTPStatus.PARTIAL_CONTENT, headers)


def _json(content: Any) -> _Answer:
    return _Answer(json.dumps(content, allow_nan=False).encode(), "application/json")


def _problem(status: HTTPStatus, reason: str) -> _Answer:
    return _Answer(json.dumps({"error": reason}).encode(), "application/json", status)


def _file(path: Path) -> _Answer:
    # Names of built files hold a hash of what is in them.
    return _Answer(
        path.read_bytes(),
        _TYPES.get(path.suffix, "application/octet-stream"),
        headers=(("Cache-Control", "private, max-age=86400"),),
    )


def _picture_answer(body: bytes | None) -> _Answer:
    if body is None:
        raise _Refused(HTTPStatus.NOT_FOUND, "the picture cannot be decoded")
    return _Answer(body, "image/jpeg", headers=(("Cache-Control", "private, max-age=3600"),))


def _picture(scene: Scene, query: dict[str, str]) -> Path:
    image_id = _whole(query, "image")
    if scene.evidence is not None:
        images = scene.evidence.dataset.images
        row = int(np.searchsorted(images.image_id, image_id))
        if row < len(images) and images.image_id[row] == image_id:
            path = picture_file(scene.pictures, scene.evidence.image_name(row))
            if path is not None:
                return path
    raise _Refused(HTTPStatus.NOT_FOUND, f"image {image_id} has no picture in the folder of pictures")


def _whole(query: dict[str, str], name: str) -> int:
    text = query.get(name, "")
    if not text.removeprefix("-").isdecimal() or len(text) > 18:
        raise _Refused(HTTPStatus.BAD_REQUEST, f"{name}: expected a whole number")
    return int(text)


def _coordinate(query: dict[str, str], name: str) -> float:
    try:
        value = float(query.get(name, ""))
    except ValueError:
        value = math.nan
    if not abs(value) <= _LARGEST_COORDINATE:
        raise _Refused(HTTPStatus.BAD_REQUEST, f"{name}: expected a number")
    return value
