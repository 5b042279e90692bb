"""The simulated driver as a ROS node."""
