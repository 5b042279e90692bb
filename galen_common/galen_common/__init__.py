"""What nodes and commands share without ROS: parameters, command layer, streams, procedures."""
