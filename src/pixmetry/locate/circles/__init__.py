"""Circles seen as ellipses."""
