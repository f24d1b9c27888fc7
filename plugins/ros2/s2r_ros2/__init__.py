"""ROS 2 over Zenoh, without ROS."""
