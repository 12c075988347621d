"""From a model and observations to its posterior: samplers, chains, mode, summary, diagnostics.

Nothing here knows of files, messages or plots.
"""
