"""The ROS 2 nodes: they translate messages, parameters and services, and own no mathematics.

This is the only folder that imports rclpy; nothing outside it may need a ROS installation.
"""
