"""What the panel tells, in words. No ROS, no NiceGUI."""
