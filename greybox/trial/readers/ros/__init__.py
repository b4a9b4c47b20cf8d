"""ROS 1 bags, ROS 2 bags and MCAP files: an extra, loaded only when such a file is read."""
