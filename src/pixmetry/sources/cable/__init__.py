"""Sources of the cable between an analogue camera and its frame grabber."""
