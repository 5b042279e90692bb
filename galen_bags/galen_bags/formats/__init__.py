"""Files of bags: MCAP, SQLite3, ROS 1; reading and writing."""
