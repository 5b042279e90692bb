"""What the Galen nodes share on the ROS side: parameters, diagnostics, conversions, spinning."""
