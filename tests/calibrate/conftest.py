"""What tests of calibrations share."""

from __future__ import annotations

import pytest

from pixmetry.report.page import Figure


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages without their drawings, which take four fifths of a calibration's time: for tests that ask for numbers and words."""
    monkeypatch.setattr(Figure, "svg", "<svg></svg>")
