"""Inputs of the network of a ray, and its colour: their constants; ``field/shading.py`` defines them."""

CHANGE = 4.0
"""Change of the log odds of a colour for each unit of network output: a middle grey then changes by one unit."""
MOST_CHANGE = 8.0
"""Maximum of that change."""
LEAST_MASS = 1e-6
"""Rays with less accumulated weight are almost invisible, whatever their colour."""
