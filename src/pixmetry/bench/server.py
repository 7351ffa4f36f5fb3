"""The server of the page: on loopback, for who has the link; it computes, and writes nothing."""

from __future__ import annotations

import asyncio
import hmac
import json
from collections.abc import AsyncIterator, Awaitable, Callable, Mapping
from contextlib import asynccontextmanager
from importlib.resources import files
from typing import TYPE_CHECKING, Any

from pixmetry.bench.clerk import Clerk
from pixmetry.bench.controls import camera_record, catalogue_record
from pixmetry.bench.gate import AHEAD, Gate, GoOn, Overtaken, Refused
from pixmetry.bench.picture import found_in, picture_of, without_chosen
from pixmetry.bench.result import Result
from pixmetry.bench.state import BenchState, Shelf, budget_target, read_state
from pixmetry.bench.take_away import taken_away
from pixmetry.bench.views import even_fields, exposed_rows, hour, over_a_pixel, video_line
from pixmetry.bench.worker import finite
from pixmetry.camera.kept_steps import KeptSteps
from pixmetry.core.config import parse_yaml
from pixmetry.core.errors import InputError, PixmetryError
from pixmetry.scene.files import read_scene

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response

MOST_BYTES = 512 << 10  # of what a page may send
MOST_READING = 64 << 20  # bytes, announced, of all that is being read
READING_S = 5.0  # in which a page must send what it announced
LONGEST_NAME = 64  # of a page
SECURITY = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
TYPES = {"html": "text/html; charset=utf-8", "css": "text/css; charset=utf-8", "js": "text/javascript; charset=utf-8"}
Work = Callable[[BenchState, GoOn], Any]


def page_files() -> dict[str, tuple[bytes, str]]:
    """The files of the page by name, with their types."""
    found = {}
    for path in (files("pixmetry.bench") / "page").iterdir():
        ending = path.name.rpartition(".")[2]
        if ending in TYPES:
            found[path.name] = path.read_bytes(), TYPES[ending]
    return found


def page_route(first: str) -> Callable[[Request], Awaitable[Response]]:
    """The endpoint that gives the files of the page; ``first`` where none is named."""
    from starlette.responses import Response

    pages = page_files()

    async def page(request: Request) -> Response:
        name = request.path_params.get("name") or first
        if name not in pages:
            return Response("there is no such file", 404)
        body, kind = pages[name]
        return Response(body, media_type=kind)

    return page


class Desk:
    """Takes in what pages send: not more at a time than `MOST_READING`, and none for longer than `READING_S`."""

    def __init__(self) -> None:
        self.reading = 0

    async def sent(self, request: Request) -> dict[str, Any]:
        """What a page sent.

        Raises
        ------
        Refused
            If too much is being read already.
        InputError
            If it is no JSON with keys, or does not come.
        """
        length = int(request.headers["content-length"])
        if self.reading + length > MOST_READING:
            raise Refused
        self.reading += length
        try:
            body = await asyncio.wait_for(request.body(), READING_S)
        except TimeoutError:
            raise InputError("less came than was announced", where="state", remedy="send it again") from None
        finally:
            self.reading -= length
        try:
            values = json.loads(body)
        except (ValueError, RecursionError):
            raise InputError("not JSON", where="state") from None
        if not isinstance(values, dict):
            raise InputError("not a state", where="state", allowed="keys with values")
        return values

    async def state(self, request: Request) -> BenchState:
        """The state that a page sent."""
        return read_state(await self.sent(request))


class Guard:
    """Lets in only who has the link, from this machine and this page, with little to read; an ASGI middleware.

    The token is the first part of every path. A foreign Host (a name that was bound to this address), a foreign Origin, and bodies beyond
    `MOST_BYTES` are refused before anything is read.
    """

    def __init__(self, app: Any, token: str, hosts: frozenset[str]) -> None:
        self.app, self.token, self.hosts = app, token, hosts

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        from starlette.responses import PlainTextResponse

        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        headers = {k.decode("latin-1").lower(): v.decode("latin-1") for k, v in scope["headers"]}
        refused = self._refused(scope["path"], scope["method"], headers)
        if refused is not None:
            await PlainTextResponse(refused[1], refused[0], headers=SECURITY)(scope, receive, send)
            return

        async def secured(message: Any) -> None:
            if message["type"] == "http.response.start":
                own = [(k.lower().encode(), v.encode()) for k, v in SECURITY.items()]
                message = {**message, "headers": [*message.get("headers", []), *own]}
            await send(message)

        path = "/" + scope["path"].split("/", 2)[2]
        await self.app({**scope, "path": path, "raw_path": path.encode(), "root_path": ""}, receive, secured)

    def _refused(self, path: str, method: str, headers: Mapping[str, str]) -> tuple[int, str] | None:
        if headers.get("host", "").lower() not in self.hosts:
            return 403, "this server answers to its own address only"
        origin = headers.get("origin")
        if origin is not None and origin.lower() not in {f"http://{host}" for host in self.hosts}:
            return 403, "asked from a foreign page"
        if headers.get("sec-fetch-site", "none") not in ("none", "same-origin"):
            return 403, "asked from a foreign page"
        parts = path.split("/", 2)
        if len(parts) < 3 or not hmac.compare_digest(parts[1].encode(), self.token.encode()):
            return 403, "the link lacks its token: open the link that the command printed"
        if method == "POST":
            if headers.get("content-type", "").partition(";")[0] != "application/json":
                return 415, "JSON is expected"
            length = headers.get("content-length", "")
            if not length.isdigit():
                return 411, "the length must be told"
            if int(length) > MOST_BYTES:
                return 413, "that is too much"
        return None


def app_of(shelf: Shelf, token: str, port: int, given: tuple[str, ...] = (), first: Mapping[str, Any] | None = None) -> Starlette:
    """The application.

    Parameters
    ----------
    shelf : Shelf
    token : str
        First part of every path.
    port : int
        Of the address, as clients name it.
    given : tuple of str
        Cameras of the command line, for the process of budgets.
    first : mapping, optional
        The state to begin with.
    """
    from starlette.applications import Starlette
    from starlette.middleware import Middleware
    from starlette.responses import JSONResponse, StreamingResponse
    from starlette.routing import Route

    gate, kept, clerk, desk, page = Gate(), KeptSteps(), Clerk(given), Desk(), page_route("index.html")

    async def opening(request: Request) -> Response:
        return JSONResponse({"catalogue": catalogue_record(), "cameras": list(shelf.names), "state": dict(first or {})})

    def computed(work: Work) -> Callable[[Request], Awaitable[Response]]:
        """An endpoint that takes a state and answers with what ``work`` makes of it."""

        async def endpoint(request: Request) -> Response:
            kind = request.url.path.rpartition("/")[2]
            try:
                state = await desk.state(request)
                if kind in AHEAD:
                    clerk.be_still()
                return JSONResponse(finite(await gate.run(_page_of(request), kind, lambda go_on: work(state, go_on))))
            except (PixmetryError, Refused, Overtaken) as problem:
                return _problem(problem)

        return endpoint

    async def budget(request: Request) -> Response:
        try:
            state = await desk.state(request)
            await gate.run(_page_of(request), "budget", lambda go_on: shelf.laid_out(state))
        except (PixmetryError, Refused, Overtaken) as problem:
            return _problem(problem)
        lines = clerk.lines(_page_of(request), state.model_dump(mode="json", by_alias=True))
        try:
            begin = await anext(lines)
        except (Refused, Overtaken, StopAsyncIteration) as problem:
            return _problem(problem)

        async def all_lines() -> AsyncIterator[bytes]:
            try:
                yield begin
                async for line in lines:
                    yield line
            finally:
                await lines.aclose()  # type: ignore[attr-defined]

        return StreamingResponse(all_lines(), media_type="application/x-ndjson")

    async def read(request: Request) -> Response:
        """The record of a camera file, a data sheet or a scene file that the page sends as text."""
        try:
            text = (await desk.sent(request)).get("text")
            record = dict(parse_yaml(text if isinstance(text, str) else "", "the file"))
            scene = record.get("schema") == "pixmetry/scene/1"
            sent = {"scene": read_scene(record).model_dump(mode="json", by_alias=True, exclude_unset=True)} if scene else {"record": record}
            state = read_state(sent)
            like = await gate.run(_page_of(request), "read", lambda go_on: budget_target(shelf.laid_out(state)))
            return JSONResponse({"scene": state.scene, "target": like} if scene else {"record": record})
        except (PixmetryError, Refused, Overtaken) as problem:
            return _problem(problem)

    def picture(state: BenchState, go_on: GoOn) -> Any:
        layout = shelf.laid_out(state)
        seen = picture_of(layout, kept)
        return {"picture": seen.to_record(), "true_px": layout.true_px}

    def found(state: BenchState, go_on: GoOn) -> Any:
        layout = shelf.laid_out(state)
        seen = picture_of(layout, kept, go_on=go_on)
        go_on()
        answer: dict[str, Any] = {"found": found_in(seen, layout, layout.true_px).to_record()}
        other = without_chosen(layout)
        if other is not None:
            try:
                beside = picture_of(other, kept, go_on=go_on)
            except PixmetryError:  # no frame is made without it
                return answer
            go_on()
            answer |= {"beside": beside.to_record(), "beside_found": found_in(beside, other, other.true_px).to_record()}
        return answer

    works: dict[str, Work] = {
        "camera": lambda state, go_on: camera_record(shelf.laid_out(state)),
        "picture": picture,
        "found": found,
        "fields": lambda state, go_on: even_fields(shelf.laid_out(state), kept),
        "line": lambda state, go_on: video_line(shelf.laid_out(state), kept),
        "hour": lambda state, go_on: hour(shelf.laid_out(state)),
        "pixel": lambda state, go_on: over_a_pixel(shelf, state, kept, go_on),
        "rows": lambda state, go_on: exposed_rows(shelf.laid_out(state)),
        "away": lambda state, go_on: taken_away(shelf.laid_out(state)),
    }

    @asynccontextmanager
    async def lifespan(app: Any) -> AsyncIterator[None]:
        yield
        await clerk.stop()

    routes = [
        Route("/", page),
        Route("/opening", opening),
        Route("/read", read, methods=["POST"]),
        Route("/budget", budget, methods=["POST"]),
        *(Route(f"/{name}", computed(work), methods=["POST"]) for name, work in works.items()),
        Route("/{name}", page),
    ]
    return Starlette(routes=routes, middleware=[Middleware(Guard, token=token, hosts=hosts_of(port))], lifespan=lifespan)


def app_of_result(result: Result, token: str, port: int) -> Starlette:
    """The application that shows one result; ``token`` and ``port`` as of `app_of`."""
    from starlette.applications import Starlette
    from starlette.middleware import Middleware
    from starlette.responses import JSONResponse, Response
    from starlette.routing import Route

    gate, page = Gate(), page_route("view.html")

    async def record(request: Request) -> Response:
        return JSONResponse(finite(result.to_record()))

    async def values(request: Request) -> Response:
        number = request.path_params["number"]
        if number >= len(result.maps):
            return Response("there is no such map", 404)
        try:
            return JSONResponse(await gate.run(_page_of(request), "map", lambda go_on: result.maps[number].to_record()))
        except (PixmetryError, Refused, Overtaken) as problem:
            return _problem(problem)

    routes = [Route("/", page), Route("/result", record), Route("/map/{number:int}", values), Route("/{name}", page)]
    return Starlette(routes=routes, middleware=[Middleware(Guard, token=token, hosts=hosts_of(port))])


def hosts_of(port: int) -> frozenset[str]:
    """The names under which a page may ask for this server."""
    return frozenset(f"{name}:{port}" for name in ("127.0.0.1", "localhost"))


def _page_of(request: Request) -> str:
    return request.headers.get("x-page", "")[:LONGEST_NAME]


def _problem(problem: Exception) -> Response:
    from starlette.responses import JSONResponse

    if isinstance(problem, Overtaken):
        return JSONResponse({"overtaken": True})
    if isinstance(problem, PixmetryError):
        return JSONResponse({"error": str(problem)})
    return JSONResponse({"error": "the server has too much to do: try again in a moment"}, 503, headers={"Retry-After": "1"})
