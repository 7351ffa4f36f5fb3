"""What falls on the lens: how the object is lit and looked at."""
