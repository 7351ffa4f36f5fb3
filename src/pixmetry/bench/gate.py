"""How much work a server takes on: one piece at a time, the newest of each page, and no more waiting than a few."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Callable
from typing import TypeVar

MOST_WAITING = 32
MOST_PAGES = 256  # of which it is known what they asked last
Result = TypeVar("Result")


class Refused(Exception):
    """There is too much work already."""


class Overtaken(Exception):
    """The same page has asked for something newer."""


class Gate:
    """Lets pieces of work through one by one, in threads of the event loop.

    Of one page (``who``) only the newest waits: older requests that have not begun raise `Overtaken`. When `MOST_WAITING` wait, more raise
    `Refused`.
    """

    def __init__(self) -> None:
        self.lock, self.waiting, self.newest = asyncio.Lock(), 0, OrderedDict[str, int]()
        self.count = 0

    async def run(self, who: str, work: Callable[[], Result]) -> Result:
        """Do a piece of work of one page, after what came before it."""
        if self.waiting >= MOST_WAITING:
            raise Refused
        self.count += 1
        mine = self.newest[who] = self.count
        self.newest.move_to_end(who)
        while len(self.newest) > MOST_PAGES:
            self.newest.popitem(last=False)
        self.waiting += 1
        try:
            await self.lock.acquire()
        finally:
            self.waiting -= 1
        if self.newest.get(who, mine) != mine:
            self.lock.release()
            raise Overtaken
        working = asyncio.ensure_future(asyncio.to_thread(work))
        working.add_done_callback(lambda _: self.lock.release())  # even where nobody waits for it any more
        return await asyncio.shield(working)
