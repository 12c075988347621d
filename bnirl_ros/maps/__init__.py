"""Maps: occupancy, Nav2 map files and text grids, and the way between cells and metres.

A map knows which cells are free and where they lie; what anybody does on it is not its business.
"""
