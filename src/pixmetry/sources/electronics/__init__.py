"""Sources of the camera's electronics."""
