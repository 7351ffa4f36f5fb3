"""Sources of the lens and of plates in front of the sensor."""
