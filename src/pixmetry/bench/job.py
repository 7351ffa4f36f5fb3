"""Open the bench: a server on loopback, and the link to its page."""

from __future__ import annotations

import secrets
import socket
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from pixmetry.bench.state import GIVEN, Shelf, budget_target, given_camera, read_state
from pixmetry.core.config import load_yaml
from pixmetry.core.extras import import_extra
from pixmetry.scene.files import read_scene

SCENE = "pixmetry/scene/1"
ADDRESS = "127.0.0.1"
TOKEN_BYTES = 24
MOST_CONNECTIONS = 1000


def open_bench(
    shown: Sequence[str | Path] = (),
    first: Mapping[str, Any] | None = None,
    *,
    port: int = 0,
    tell: Callable[[str], None] = print,
) -> None:
    """Serve the bench on loopback until it is stopped.

    Parameters
    ----------
    shown : sequence of path or name
        One camera, by one description or several; without one, a preset. The last may be a scene file.
    first : mapping, optional
        The state to begin with, see `pixmetry.bench.state.BenchState`.
    port : int
        0 for one that is free.
    tell : callable
        Called with the link, as soon as the page can be opened.

    Raises
    ------
    InputError
        If the packages of the extra ``bench`` are missing, or camera or state cannot be used.
    """
    import_extra("starlette")
    import_extra("uvicorn")
    from pixmetry.bench.controls import catalogue_record
    from pixmetry.bench.server import app_of

    cameras, scene = told_apart(shown)
    camera = given_camera(cameras)
    begin: dict[str, Any] = dict(first or {})
    if camera is not None and "camera" not in begin:
        begin["camera"] = str(cameras[0]) if len(cameras) == 1 and str(cameras[0]) in Shelf().names else GIVEN
    shelf = Shelf(camera)
    if scene is not None:
        begin["scene"] = scene
        scenario = dict(begin.get("scenario", {}))
        like = budget_target(shelf.laid_out(read_state(begin)))
        begin["scenario"] = scenario | {"target": like | dict(scenario.get("target", {}))}
    shelf.laid_out(read_state(begin)).window  # noqa: B018 - what cannot be shown is said at once
    catalogue_record()
    _serve(lambda token, own: app_of(shelf, token, own, tuple(str(c) for c in cameras), begin), port, tell)


def told_apart(shown: Sequence[str | Path]) -> tuple[tuple[str | Path, ...], dict[str, Any] | None]:
    """Descriptions of a camera, and the record of the scene file that comes last; None if there is none."""
    if not shown:
        return (), None
    *cameras, last = shown
    path = Path(last)
    if path.suffix.lower() in (".yaml", ".yml") and path.is_file():
        record = load_yaml(path)
        if record.get("schema") == SCENE:
            return tuple(cameras), read_scene(path).model_dump(mode="json", by_alias=True, exclude_unset=True)
    return tuple(shown), None


def open_view(result: str | Path, pictures: Sequence[str | Path] = (), *, port: int = 0, tell: Callable[[str], None] = print) -> None:
    """Show a result on loopback until it is stopped.

    Parameters
    ----------
    result : path
        A folder of results, a JSON file, or a table, see `pixmetry.bench.result.read_result`.
    pictures : sequence of path
        Images that the positions belong to, or folders of them.
    port, tell
        As of `open_bench`.

    Raises
    ------
    InputError
        If the packages of the extra ``bench`` are missing, or there is no such result.
    """
    import_extra("starlette")
    import_extra("uvicorn")
    from pixmetry.bench.result import read_result
    from pixmetry.bench.server import app_of_result

    shown = read_result(result, pictures)
    _serve(lambda token, own: app_of_result(shown, token, own), port, tell)


def _serve(app_with: Callable[[str, int], Any], port: int, tell: Callable[[str], None]) -> None:
    """Serve an application, which is made with its token and port, and tell the link."""
    uvicorn = import_extra("uvicorn")
    listening = socket.create_server((ADDRESS, port))
    token, own = secrets.token_urlsafe(TOKEN_BYTES), listening.getsockname()[1]
    app = app_with(token, own)
    tell(f"http://{ADDRESS}:{own}/{token}/")
    settings = uvicorn.Config(app, log_level="warning", access_log=False, server_header=False, limit_concurrency=MOST_CONNECTIONS)
    uvicorn.Server(settings).run(sockets=[listening])
