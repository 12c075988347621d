"""Demonstrations from files, one or a fleet's: read, pooled, and inferred from side by side.

What is done with one demonstration is done by the rooms above; here is only what makes many of
them bearable: workers, on this machine or on a Dask cluster, that may die, and the account of what
became of each. Terminals and ROS have no place here.
"""
