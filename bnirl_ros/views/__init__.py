"""What is shown of maps, demonstrations and posteriors: messages as dataclasses, plots, tables.

Every view is a pure function of what it shows (a plot also writes its one file); nothing here
ever computes a posterior, knows of rclpy, or decides when to publish.
"""
