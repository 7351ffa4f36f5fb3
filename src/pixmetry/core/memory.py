"""How much memory there is, asked before it is taken: the system may end a process that takes more, without a word."""

from __future__ import annotations

import os
import re
import sys
from pathlib import Path

from pixmetry.core.errors import InputError

UNASKED_BYTES = 1 << 20  # what a process takes at any time; to ask the system takes as long as to read such a file
_GROUP = (  # limit, use, and what of it is held by files: control groups 2 and 1
    ("memory.max", "memory.current", "inactive_file"),
    ("memory/memory.limit_in_bytes", "memory/memory.usage_in_bytes", "total_inactive_file"),
)


def available_bytes() -> int:
    """Return the memory that this process can still take.

    Returns
    -------
    int
        The least of what the system has without swapping (``MemAvailable``), what is left of a container's limit, and what is left of
        the limit of the process (``ulimit -v``); `sys.maxsize` where the system tells none of these.
    """
    known = [value for value in (_of_system(), _of_group(), _of_process()) if value is not None]
    return max(min(known, default=sys.maxsize), 0)


def check_memory(needed_bytes: float, what: str, *, where: str = "", remedy: str) -> None:
    """Refuse what does not fit into the memory there is.

    Parameters
    ----------
    needed_bytes : float
    what : str
        What needs it, as the subject of a sentence: ``"a frame of 60000 x 60000 pixels"``.
    where : str
    remedy : str

    Raises
    ------
    InputError
        If fewer bytes are available.
    """
    if needed_bytes <= UNASKED_BYTES:
        return
    available = available_bytes()
    if needed_bytes > available:
        allowed = f"up to {_size(available)}, the free memory"
        raise InputError(f"{what} needs {_size(needed_bytes)} of memory", where=where, allowed=allowed, remedy=remedy)


def _size(count: float) -> str:
    for unit in ("bytes", "KiB", "MiB", "GiB"):
        if count < 1024 or unit == "GiB":
            break
        count /= 1024
    return f"{count:.3g} {unit}" if count < 1e6 else f"{count:.2g} {unit}"


def _of_system() -> int | None:
    try:
        found = re.search(r"^MemAvailable:\s*(\d+) kB", Path("/proc/meminfo").read_text(), re.MULTILINE)
    except OSError:
        found = None
    if found:
        return int(found[1]) * 1024
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return None


def _of_group() -> int | None:
    """Free memory of a container; its cached file pages count as free."""
    for limit, usage, held in _GROUP:
        try:
            most = int((root := Path("/sys/fs/cgroup") / limit).read_text())
            used = int((root.parent / Path(usage).name).read_text())
            found = re.search(rf"^{held} (\d+)", (root.parent / "memory.stat").read_text(), re.MULTILINE)
        except (OSError, ValueError):  # no such limit: the file is missing, or says "max"
            continue
        return most - used + (int(found[1]) if found else 0)
    return None


def _of_process() -> int | None:
    try:
        import resource

        most = resource.getrlimit(resource.RLIMIT_AS)[0]
        if most == resource.RLIM_INFINITY:
            return None
        return most - int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    except (ImportError, OSError, ValueError):
        return None
