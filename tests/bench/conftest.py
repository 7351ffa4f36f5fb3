"""A server of the bench in this process, and requests to it as its page makes them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

TOKEN, PORT = "a-token-of-tests", 8350


@pytest.fixture(scope="session")
def server() -> Iterator[Any]:
    pytest.importorskip("starlette")
    pytest.importorskip("httpx2")
    from starlette.testclient import TestClient

    from pixmetry.bench.server import app_of
    from pixmetry.bench.state import Shelf

    with TestClient(app_of(Shelf(), TOKEN, PORT), base_url=f"http://127.0.0.1:{PORT}/{TOKEN}") as client:
        yield client
