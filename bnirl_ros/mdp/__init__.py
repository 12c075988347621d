"""Markov decision processes: the grid world, the general finite one, and their goal values.

States, actions, transitions and values live here; demonstrations, likelihoods and metres never.
"""
