"""Robots' recordings (ROS 1 and ROS 2 bags) read, localised and written without ROS: rosbags, NumPy and OpenCV."""
