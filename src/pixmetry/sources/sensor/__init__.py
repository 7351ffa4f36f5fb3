"""Sources of the sensor, from the pixels' geometry to the read-out."""
