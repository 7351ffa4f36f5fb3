"""The general model of release 4.0: cameras whose response is not a line."""
