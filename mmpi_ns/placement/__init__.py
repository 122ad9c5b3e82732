"""Where MPIs stand: observations, candidates, expected pixel errors, choice, plan."""
