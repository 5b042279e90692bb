"""What the Galen nodes share on the ROS side: nodes, diagnostics, conversions, spinning."""
