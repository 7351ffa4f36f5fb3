"""Sources of the processing in the camera or the computer."""
