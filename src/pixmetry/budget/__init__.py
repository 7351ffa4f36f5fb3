"""What every error source does to a target's position, put together: probe, Monte Carlo, ranking and advice."""

from pixmetry.budget.combine import combine
from pixmetry.budget.job import Budget, BudgetRow, compute_budget
from pixmetry.budget.monte_carlo import monte_carlo
from pixmetry.budget.probe import Target, facts_of, make_probe, parse_target

__all__ = ["Budget", "BudgetRow", "Target", "combine", "compute_budget", "facts_of", "make_probe", "monte_carlo", "parse_target"]
