"""System calls that fail, or are interrupted, when they are made for the k-th time."""

from __future__ import annotations

import errno
from typing import Any

# What happens, and whether after the call has done its work: a failure, an interruption before it and one right after it.
FAULTS: list[tuple[BaseException, bool]] = [
    (OSError(errno.EIO, "broken"), False),
    (KeyboardInterrupt(), False),
    (KeyboardInterrupt(), True),
]


class Failing:
    """A system call that fails at its k-th call: instead of what it does, or right after it.

    Parameters
    ----------
    call : callable
    at : int
        From 1.
    problem : BaseException
    after : bool
    """

    def __init__(self, call: Any, at: int, problem: BaseException, after: bool) -> None:
        self.call, self.at, self.problem, self.after, self.calls = call, at, problem, after, 0

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        self.calls += 1
        if self.calls == self.at and not self.after:
            raise self.problem
        result = self.call(*args, **kwargs)
        if self.calls == self.at:
            raise self.problem
        return result
