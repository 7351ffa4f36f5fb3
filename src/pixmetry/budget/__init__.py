"""What every error source does to a target's position, put together: probe, Monte Carlo, ranking and advice."""
