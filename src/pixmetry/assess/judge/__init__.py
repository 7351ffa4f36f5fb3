"""Results held against each other and against limits: two of a camera, a fleet, the limits of a data sheet."""
