"""How much work a server takes on: one piece at a time, pages in turn, of each page the newest, and no more waiting than a few."""

from __future__ import annotations

import asyncio
from collections import OrderedDict
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, TypeVar

MOST_WAITING = 32  # pages with work that has not begun
MOST_PAGES = 256  # of which it is known that they have been answered
AHEAD = frozenset({"picture"})  # kinds of work that go before the others of their page, and end these
Result = TypeVar("Result")
GoOn = Callable[[], None]


class Refused(Exception):
    """There is too much work already."""


class Overtaken(Exception):
    """The same page has asked for something newer."""


class Seats:
    """Who may wait: `MOST_WAITING` pages, and a page that was answered before goes before one that was not."""

    def __init__(self) -> None:
        self.known: OrderedDict[str, None] = OrderedDict()

    def answered(self, page: str) -> None:
        """Remember a page that was answered."""
        self.known[page] = None
        self.known.move_to_end(page)
        while len(self.known) > MOST_PAGES:
            self.known.popitem(last=False)

    def given_up_for(self, page: str, waiting: Iterable[str]) -> str | None:
        """The page that gives its seat to this one, None if there is a free seat.

        Raises
        ------
        Refused
            If none is to be had.
        """
        there = list(waiting)
        if page in there or len(there) < MOST_WAITING:
            return None
        stranger = next((p for p in reversed(there) if p not in self.known), None)
        if stranger is None or page not in self.known:
            raise Refused
        return stranger


@dataclass(eq=False)
class _Piece:
    """Work of a page; ``unwanted``: it shall end early."""

    page: str
    kind: str
    work: Callable[[GoOn], Any]
    answer: asyncio.Future[Any]
    unwanted: bool = False

    def go_on(self) -> None:
        if self.unwanted:
            raise Overtaken

    def ends_for(self, page: str, kind: str) -> bool:
        return self.page == page and kind in AHEAD and self.kind not in AHEAD

    def fail(self, problem: Exception) -> None:
        if not self.answer.done():
            self.answer.set_exception(problem)


class Gate:
    """Lets pieces of work through one by one, in threads of the event loop; the pages that wait take turns.

    Of one page and kind only the newest waits: an older one that has not begun raises `Overtaken` at once. A piece that has begun ends
    early where the same page asks for what goes `AHEAD`. When `MOST_WAITING` pages wait, more raise `Refused`; a page that floods so takes
    no seat but its own, and pages under ever new names no seat from those that were answered before.
    """

    def __init__(self) -> None:
        self.seats = Seats()
        self.waiting: OrderedDict[str, dict[str, _Piece]] = OrderedDict()  # by page and kind, in the order of the turns
        self.present: _Piece | None = None

    async def run(self, page: str, kind: str, work: Callable[[GoOn], Result]) -> Result:
        """Do a piece of work of one page when it is its turn; ``work`` is handed a function to call now and then, which ends it if need be.

        Raises
        ------
        Refused
            If too many wait already.
        Overtaken
            If the same page asks again before its turn, or for what goes ahead.
        """
        pushed_out = self.seats.given_up_for(page, self.waiting)
        if pushed_out is not None:
            for piece in self.waiting.pop(pushed_out).values():
                piece.fail(Refused())
        mine = _Piece(page, kind, work, asyncio.get_running_loop().create_future())
        own = self.waiting.setdefault(page, {})
        older = own.pop(kind, None)
        if older is not None:
            older.fail(Overtaken())
        own[kind] = mine
        if self.present is None:
            self._next()
        elif self.present.ends_for(page, kind):
            self.present.unwanted = True
        result: Result = await mine.answer
        return result

    def _next(self) -> None:
        """Begin the next piece: of the page whose turn it is, what goes ahead, else what was asked first."""
        self.present = None
        if not self.waiting:
            return
        page, own = self.waiting.popitem(last=False)
        kind = next((k for k in own if k in AHEAD), next(iter(own)))
        piece = self.present = own.pop(kind)
        if own:
            self.waiting[page] = own  # at the end
        working = asyncio.ensure_future(asyncio.to_thread(piece.work, piece.go_on))
        working.add_done_callback(lambda done: self._end(piece, done))

    def _end(self, piece: _Piece, done: asyncio.Future[Any]) -> None:
        problem = asyncio.CancelledError() if done.cancelled() else done.exception()
        if not piece.answer.done():
            if problem is None:
                self.seats.answered(piece.page)
                piece.answer.set_result(done.result())
            else:
                piece.answer.set_exception(problem)
        self._next()
