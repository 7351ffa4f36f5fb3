"""Procedures that reduce the frames of a campaign to observations, each frame read once."""
