"""What falls on the sensor: uniform light, discs, plates, lines and pictures, lit and moving.

A scene file or record enters; light over the frame, and the true places of its targets, leave.
"""
