"""Effects of the force/torque sensor."""
