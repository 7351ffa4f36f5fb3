"""Many pages at once, and one that floods: refused or queued, and every answer that is given is right."""

from __future__ import annotations

import asyncio
import json
import os
import threading
import time
from typing import Any

import pytest

from pixmetry.bench.gate import MOST_PAGES, MOST_WAITING, Gate, Overtaken, Refused

httpx = pytest.importorskip("httpx2")
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


def test_a_page_that_floods_waits_for_ten_others_and_not_they_for_it() -> None:
    async def work(client: Any) -> Any:
        flood = [asyncio.ensure_future(asked(client, "flood", n, path)) for n in range(150) for path in ("picture", "found")]
        await asyncio.sleep(0)
        others = await asyncio.gather(*(asked(client, f"page {n}", n) for n in range(10)))
        begun = sum(one.done() and "overtaken" not in one.result().json() for one in flood)
        last = await asked(client, "other", 9)
        return await asyncio.gather(*flood), others, begun, last

    replies, others, begun, last = with_server(work)
    assert all(reply.status_code == 200 for reply in [*replies, *others])  # nobody is refused
    assert [set(reply.json()) for reply in others] == [{"picture", "true_px"}] * 10
    assert others[9].json()["picture"]["data"] == last.json()["picture"]["data"]
    answered = [reply.json() for reply in replies if "overtaken" not in reply.json()]
    assert 1 <= begun <= 3 and 1 <= len(answered) <= 4  # the first that began, and the newest: between them it was the turn of the others


def test_pages_under_ever_new_names_are_refused_before_those_that_were_there() -> None:
    async def work(client: Any) -> Any:
        for n in range(10):
            await asked(client, f"page {n}", n)
        flood = [asyncio.ensure_future(asked(client, f"new {n}", n % 3)) for n in range(200)]
        await asyncio.sleep(0.05)
        others = await asyncio.gather(*(asked(client, f"page {n}", n) for n in range(10)))
        return await asyncio.gather(*flood), others

    replies, others = with_server(work)
    assert [reply.status_code for reply in others] == [200] * 10
    refused = sum(reply.status_code == 503 for reply in replies)
    assert refused >= 200 - MOST_WAITING - 10 and all(reply.headers["retry-after"] for reply in replies if reply.status_code == 503)


def test_the_gate_forgets_pages_and_lets_the_newest_through() -> None:
    async def run() -> None:
        gate, done = Gate(), []
        for n in range(3 * MOST_PAGES):
            await gate.run(f"page {n}", "a", lambda go_on: None)
        assert len(gate.seats.known) <= MOST_PAGES
        results = await asyncio.gather(*(gate.run("one", "a", lambda go_on, n=n: done.append(n)) for n in range(5)), return_exceptions=True)
        assert done == [0, 4] and [isinstance(r, Overtaken) for r in results] == [False, True, True, True, False]  # the first had begun
        crowd = [gate.run(str(n), "a", lambda go_on: None) for n in range(MOST_WAITING + 20)]
        results = await asyncio.gather(*crowd, return_exceptions=True)
        assert sum(isinstance(r, Refused) for r in results) == 19 and not gate.waiting and gate.present is None

    asyncio.run(run())


def test_pages_take_turns_and_a_picture_ends_what_is_slower() -> None:
    async def run() -> list[str]:
        gate, order, held = Gate(), [], threading.Event()

        def slow(go_on: Any) -> None:
            held.set()
            for _ in range(1000):
                time.sleep(0.01)
                go_on()

        def note(word: str) -> Any:
            return lambda go_on: order.append(word)

        first = asyncio.ensure_future(gate.run("a", "found", slow))
        while not held.is_set():
            await asyncio.sleep(0.001)
        kinds = [("a", "fields"), ("a", "line"), ("b", "found"), ("b", "picture"), ("c", "found"), ("a", "picture")]
        rest = [asyncio.ensure_future(gate.run(page, kind, note(f"{page} {kind}"))) for page, kind in kinds]
        with pytest.raises(Overtaken):
            await first
        await asyncio.gather(*rest)
        return order

    assert asyncio.run(run()) == ["a picture", "b picture", "c found", "a fields", "b found", "a line"]


def test_what_is_announced_and_does_not_come_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    from starlette.requests import Request

    from pixmetry.bench import server
    from pixmetry.core.errors import InputError

    monkeypatch.setattr(server, "READING_S", 0.02)

    async def run() -> None:
        desk = server.Desk()

        async def nothing() -> Any:
            await asyncio.sleep(60)

        def request(length: int) -> Request:
            return Request({"type": "http", "headers": [(b"content-length", str(length).encode())]}, nothing)

        most = server.MOST_READING // server.MOST_BYTES
        crowd = await asyncio.gather(*(desk.sent(request(server.MOST_BYTES)) for _ in range(most + 5)), return_exceptions=True)
        assert [type(one) for one in crowd] == [InputError] * most + [Refused] * 5
        assert desk.reading == 0

    asyncio.run(run())


@pytest.mark.skipif(os.name != "posix", reason="a process cannot be stopped here")
def test_the_process_of_budgets_is_still_while_pictures_are_asked_for() -> None:
    from pixmetry.bench.clerk import STILL_S, Clerk

    def state_of(number: int) -> str:
        with open(f"/proc/{number}/stat", encoding="ascii") as file:
            return file.read().rpartition(")")[2].split()[0]

    async def until(process: Any, stopped: bool) -> None:
        while (state_of(process.pid) == "T") != stopped:
            await asyncio.sleep(0.001)

    async def run() -> tuple[float, bool]:
        clerk = Clerk()
        process = await clerk._running()
        asked = 0.0
        for _ in range(3):
            asked = time.monotonic()
            clerk.be_still()
            await asyncio.wait_for(until(process, True), 30)
            await asyncio.sleep(0.4 * STILL_S)
        await asyncio.wait_for(until(process, False), 30)
        still_s = time.monotonic() - asked
        clerk.be_still()
        await clerk.stop()
        return still_s, process.returncode is not None

    if os.path.exists("/proc/self/stat"):
        still_s, ended = asyncio.run(run())
        assert still_s > 0.99 * STILL_S and ended  # the last of the three counts


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
