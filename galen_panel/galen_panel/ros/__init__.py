"""The panel's ROS side."""
