"""MCAP bags as rosbag2 lays them out, in and out, and the messages' definitions and CDR bytes.

Bytes, topics and time stamps live here, and no ROS; what a message means for a demonstration, or
what is shown of a posterior, never.
"""
