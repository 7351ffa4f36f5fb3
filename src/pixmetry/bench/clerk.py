"""The process of the budgets, seen from the server: one request at a time, until its page is gone or asks for something newer."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
from collections import OrderedDict
from collections.abc import AsyncIterator, Sequence

from pixmetry.bench.gate import MOST_PAGES, Overtaken, Refused, Seats

LONGEST_LINE = 1 << 24
PATIENCE_S = 15.0  # for a request to end after it was told to; then the process is ended
STILL_S = 0.25  # without a picture asked for, after which a process that was stopped goes on
ENDED = b'{"kind": "error", "text": "the budget could not be computed: its process ended"}\n'


class Clerk:
    """Hands states to the process of budgets, and its lines back.

    Parameters
    ----------
    given : sequence of str
        Cameras of the command line.
    """

    def __init__(self, given: Sequence[str] = ()) -> None:
        self.given = tuple(given)
        self.process: asyncio.subprocess.Process | None = None
        self.reading: asyncio.Task[None] | None = None
        self.busy, self.count = False, 0
        self.waiting: OrderedDict[str, asyncio.Future[None]] = OrderedDict()  # the newest of each page, in the order of their turns
        self.newest: dict[str, int] = {}
        self.seats = Seats()
        self.waking: asyncio.TimerHandle | None = None
        self.present: asyncio.Queue[bytes | None] | None = None

    async def lines(self, who: str, state: dict[str, object]) -> AsyncIterator[bytes]:
        """Lines of JSON about one state, for one page; a newer request of the same page ends them.

        Raises
        ------
        Refused
            If too many wait already.
        Overtaken
            If the same page asks again before its turn.
        """
        older = self.waiting.pop(who, None)
        if older is not None and not older.done():
            older.set_exception(Overtaken())
        pushed_out = self.seats.given_up_for(who, self.waiting)
        if pushed_out is not None:
            self.waiting.pop(pushed_out).set_exception(Refused())
        self.count += 1
        self.newest.pop(who, None)
        mine = self.newest[who] = self.count
        for oldest in list(self.newest)[:-MOST_PAGES]:
            del self.newest[oldest]
        await self._turn(who)
        if self.newest.get(who, mine) != mine:
            self._next()
            raise Overtaken
        try:
            process = await self._running()
        except BaseException:
            self._next()
            raise
        answer = self.present = asyncio.Queue()  # from here on `_read` calls the next, at the end of the request
        self.seats.answered(who)
        self._send(process, {"state": state})
        ended = False
        try:
            while self.newest.get(who, mine) == mine:
                line = await answer.get()
                if line is None:
                    ended = True
                    return
                yield line
        finally:
            if not ended:
                self._send(process, {"cancel": True})
                asyncio.get_running_loop().call_later(PATIENCE_S, self._kill_if, answer)

    async def _turn(self, who: str) -> None:
        """Wait for one's turn."""
        if not self.busy:
            self.busy = True
            return
        mine = self.waiting[who] = asyncio.get_running_loop().create_future()
        try:
            await mine
        except asyncio.CancelledError:
            if self.waiting.get(who) is mine:
                del self.waiting[who]
            elif mine.done() and not mine.cancelled() and mine.exception() is None:
                self._next()  # it was its turn
            raise

    def _next(self) -> None:
        """Give the turn to who waits longest."""
        while self.waiting:
            _, turn = self.waiting.popitem(last=False)
            if not turn.done():
                turn.set_result(None)
                return
        self.busy = False

    async def _running(self) -> asyncio.subprocess.Process:
        if self.process is None or self.process.returncode is not None or self.reading is None or self.reading.done():
            pipe = asyncio.subprocess.PIPE
            module = ("-m", "pixmetry.bench.worker", *self.given)
            # in a group of its own, which the system wakes if this process dies while the other is stopped
            own = 0 if os.name == "posix" else None
            command = (sys.executable, *module)
            self.process = await asyncio.create_subprocess_exec(*command, stdin=pipe, stdout=pipe, limit=LONGEST_LINE, process_group=own)
            self.reading = asyncio.ensure_future(self._read(self.process))
        return self.process

    async def _read(self, process: asyncio.subprocess.Process) -> None:
        """Hand the lines of the process to the present request, and end it."""
        assert process.stdout is not None
        while line := await process.stdout.readline():
            if line.startswith(b'{"kind": "end"'):
                self._finish()
            elif self.present is not None:
                self.present.put_nowait(line)
        await process.wait()
        if self.present is not None:
            self.present.put_nowait(ENDED)
            self._finish()

    def _finish(self) -> None:
        if self.present is not None:
            self.present.put_nowait(None)
            self.present = None
            self._next()

    def _send(self, process: asyncio.subprocess.Process, request: dict[str, object]) -> None:
        assert process.stdin is not None
        if process.returncode is None and not process.stdin.is_closing():
            process.stdin.write(json.dumps(request).encode() + b"\n")

    def be_still(self) -> None:
        """Stop the process while pictures are computed: it goes on when none was asked for during `STILL_S`; only where the system can."""
        if os.name != "posix" or self.process is None or self.process.returncode is not None:
            return
        if self.waking is None:
            self.process.send_signal(signal.SIGSTOP)
        else:
            self.waking.cancel()
        self.waking = asyncio.get_running_loop().call_later(STILL_S, self._wake)

    def _wake(self) -> None:
        self.waking = None
        if self.process is not None and self.process.returncode is None:
            self.process.send_signal(signal.SIGCONT)

    def _kill_if(self, answer: asyncio.Queue[bytes | None]) -> None:
        """End the process if it still computes what nobody wants."""
        if self.present is answer and self.process is not None and self.process.returncode is None:
            self.process.kill()

    async def stop(self) -> None:
        """End the process."""
        if self.process is not None and self.process.returncode is None:
            self.process.kill()
            await self.process.wait()
        if self.reading is not None:
            await asyncio.wait([self.reading])
