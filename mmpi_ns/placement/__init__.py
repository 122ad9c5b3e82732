"""Placement of MPIs: observations, candidates, expected pixel errors, choice, plan."""
