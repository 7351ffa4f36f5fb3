"""Data sheets compared: two of them, a fleet, limits."""
