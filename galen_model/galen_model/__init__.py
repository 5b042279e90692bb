"""Kinematics, wrench algebra, load model and calibration files of any arm, free of ROS."""
