"""Figures do not depend on the matplotlib settings of whoever makes them."""

from __future__ import annotations

import threading

import matplotlib
import numpy as np

from pixmetry import locate
from pixmetry.locate.overlay import overlay_png
from pixmetry.report.drawing import canvas, own_style
from pixmetry.report.page import Figure
from pixmetry.report.paper import paper

THEIRS = {"text.usetex": True, "font.family": "serif", "axes.grid": True, "lines.linewidth": 9.0, "savefig.facecolor": "red"}


def figure() -> str:
    with canvas(2.0) as (drawn, axes):
        axes.plot([1, 2, 3], [1, 4, 9])
        axes.set_xlabel("µ_y / DN & 50 %")
        return Figure(drawn, "one", "alt", "caption").svg


def page() -> bytes:
    with paper() as sheet:
        sheet.finish("footer_with_underscore")
        return sheet.to_bytes({"Title": "x"})


def overlay() -> bytes:
    y, x = np.mgrid[:40, :50]
    frame = (200 * (np.hypot(x - 25, y - 20) < 8) + 20).astype(np.uint8)
    return overlay_png(frame, locate(frame))


def test_a_users_settings_change_no_figure() -> None:
    usual = figure(), page(), overlay()
    with matplotlib.rc_context():
        matplotlib.rcParams.update(THEIRS)
        assert (figure(), page(), overlay()) == usual
        assert {name: matplotlib.rcParams[name] for name in THEIRS}["text.usetex"] is True  # and ours do not change theirs


def test_threads_do_not_change_each_others_settings() -> None:
    seen, go = [], threading.Barrier(4)

    def look(width: float) -> None:
        go.wait()
        for _ in range(50):
            with own_style({"lines.linewidth": width}):
                seen.append(matplotlib.rcParams["lines.linewidth"] == width)

    threads = [threading.Thread(target=look, args=(float(k),)) for k in range(1, 5)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(seen) == 200 and all(seen)
