"""Sources of storage: tape and codecs."""
