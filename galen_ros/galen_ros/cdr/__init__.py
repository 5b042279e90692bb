"""Serialised messages without ROS."""
