"""A data sheet on disk: JSON, XML, keys and units."""
