"""Frames of a camera whose errors are known, and one target followed through its chain.

A camera, a scene and a seed enter; frames with their truth leave.
"""
