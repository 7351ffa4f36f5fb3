"""The last lines of a benchmark: what was measured, the goal, and whether it is met."""

from __future__ import annotations


def verdict(what: str, measured: float, goal: float, unit: str = "", at_least: bool = False) -> bool:
    """Print one line and return whether the goal is met; a ratio has no unit."""
    met = measured >= goal if at_least else measured <= goal
    side = "at least" if at_least else "at most"
    print(f"goal: {what}: {measured:.3g}{unit}, {side} {goal:g}{unit}: {'met' if met else 'NOT MET'}")
    return met
