"""The model: how a demonstrator with a subgoal acts, and which subgoals it may have.

Probabilities of observations and of partitions live here; how they are sampled does not.
"""
