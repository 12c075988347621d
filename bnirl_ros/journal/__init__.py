"""What a node keeps of a demonstration that goes on, so that nothing is lost with its process.

Imports nothing of ROS; see `bnirl_ros.journal.keeper` for the whole of it.
"""
