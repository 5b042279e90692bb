"""Kinematics, wrench algebra, load model and tool files of the Galen arm, free of ROS."""
