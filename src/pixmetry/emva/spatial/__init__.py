"""Spatial nonuniformities."""
