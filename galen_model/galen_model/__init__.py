"""Kinematics, wrench algebra, load model and calibration files of the Galen arm, free of ROS."""
