"""Many pages at once, and one that floods: refused or queued, and every answer that is given is right."""

from __future__ import annotations

import asyncio
import json
from typing import Any

import pytest

from pixmetry.bench.gate import MOST_PAGES, MOST_WAITING, Gate, Overtaken, Refused

httpx = pytest.importorskip("httpx")
pytest.importorskip("starlette")

TOKEN, PORT = "token", 8351


def state(number: int) -> dict[str, Any]:
    return {"camera": "imx264_like", "side_px": 64, "seed": number, "set": {"sensor.prnu.pixel_std_rel": 0.001 * (number + 1)}}


async def asked(client: Any, page: str, number: int, path: str = "picture") -> Any:
    headers = {"Content-Type": "application/json", "X-Page": page}
    return await client.post(f"/{TOKEN}/{path}", content=json.dumps(state(number)), headers=headers)


def with_server(work: Any) -> Any:
    from pixmetry.bench.server import app_of
    from pixmetry.bench.state import Shelf

    async def run() -> Any:
        transport = httpx.ASGITransport(app=app_of(Shelf(), TOKEN, PORT))
        async with httpx.AsyncClient(transport=transport, base_url=f"http://127.0.0.1:{PORT}", timeout=600) as client:
            return await work(client)

    return asyncio.run(run())


def test_ten_pages_at_once_get_their_own_pictures() -> None:
    async def work(client: Any) -> Any:
        alone = [(await asked(client, "alone", n)).json()["picture"]["data"] for n in range(10)]
        together = await asyncio.gather(*(asked(client, f"page {n}", n) for n in range(10)))
        return alone, [reply.json()["picture"]["data"] for reply in together]

    alone, together = with_server(work)
    assert together == alone and len(set(alone)) == 10


def test_a_page_that_floods_is_refused_and_others_go_on() -> None:
    async def work(client: Any) -> Any:
        flood = [asyncio.ensure_future(asked(client, "flood", n)) for n in range(300)]
        await asyncio.sleep(0)
        replies = await asyncio.gather(*flood)
        other = await asked(client, "other", 7)
        again = await asked(client, "flood", 7)
        return replies, other, again

    replies, other, again = with_server(work)
    kinds = {"picture": 0, "overtaken": 0, "refused": 0}
    for reply in replies:
        assert reply.status_code in (200, 503)
        kinds["refused" if reply.status_code == 503 else next(k for k in ("picture", "overtaken") if k in reply.json())] += 1
    assert kinds["refused"] >= 300 - MOST_WAITING - 10 and kinds["overtaken"] > 0 and kinds["picture"] >= 1
    assert other.json()["picture"]["data"] == again.json()["picture"]["data"]


def test_the_gate_forgets_pages_and_lets_the_newest_through() -> None:
    async def run() -> None:
        gate, done = Gate(), []
        for n in range(3 * MOST_PAGES):
            await gate.run(f"page {n}", lambda: None)
        assert len(gate.newest) <= MOST_PAGES
        results = await asyncio.gather(*(gate.run("one", lambda n=n: done.append(n)) for n in range(5)), return_exceptions=True)
        assert done == [0, 4] and [isinstance(r, Overtaken) for r in results] == [False, True, True, True, False]  # the first had begun
        results = await asyncio.gather(*(gate.run(str(n), lambda: None) for n in range(MOST_WAITING + 20)), return_exceptions=True)
        assert sum(isinstance(r, Refused) for r in results) in range(1, 21) and gate.waiting == 0

    asyncio.run(run())


def test_a_budget_that_nobody_reads_any_more_ends_and_the_next_one_begins() -> None:
    from pixmetry.bench.clerk import Clerk

    async def run() -> tuple[list[Any], int]:
        clerk = Clerk()
        first = clerk.lines("a", {"camera": "imx264_like"})
        await anext(first)
        await first.aclose()
        second = clerk.lines("b", {"camera": "imx264_like", "scenario": {"target": {"diameter_px": 1e6}}})
        told = [json.loads(line) async for line in second]
        assert clerk.process is not None
        number = clerk.process.pid
        clerk.process.kill()
        await clerk.process.wait()
        third = clerk.lines("a", {"camera": "imx264_like"})
        await anext(third)
        assert clerk.process.pid != number and not clerk.waiting
        crowd = [asyncio.ensure_future(anext(clerk.lines("flood", {"camera": "imx264_like", "seed": n}))) for n in range(200)]
        overtaken = await asyncio.gather(*crowd[:-1], return_exceptions=True)
        assert all(isinstance(one, Overtaken) for one in overtaken) and len(clerk.waiting) == 1
        await third.aclose()
        assert json.loads(await crowd[-1])["kind"] == "begin"
        await clerk.stop()
        return told, len(clerk.newest)

    told, pages = asyncio.run(run())
    assert [line["kind"] for line in told] == ["error"] and pages == 3
