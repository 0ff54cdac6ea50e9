"""Robots' recordings (ROS 1 and ROS 2 bags) read, localized and written without ROS: rosbags, NumPy and OpenCV."""
