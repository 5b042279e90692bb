"""The sensor's rotation and gains, the base's inclination, the joints' zeros."""
