"""What needs ROS: nodes, and commands that talk to them."""
