"""The simulated arm, sensor, tracker and operator."""
