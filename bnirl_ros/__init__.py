"""Bayesian nonparametric inverse reinforcement learning for ROS 2 (Michini & How 2012)."""

__version__ = "0.1.0"
