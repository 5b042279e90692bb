"""What the panel knows, and its numbers. No ROS, no page."""
