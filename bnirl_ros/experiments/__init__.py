"""Scenarios, each defined once, the bags that are made of them, and studies of the method on them.

Whatever is a demonstrator of our own or somebody else's data lives here; the method itself, and
anything that needs ROS, never does.
"""
