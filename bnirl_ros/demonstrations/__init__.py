"""Demonstrations: observations, how poses and actions pair up, where episodes end.

What was seen lives here, live and offline by the same code; what it means never does.
"""
