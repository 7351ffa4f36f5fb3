"""Sources of the lens and what stands in front of the sensor."""
