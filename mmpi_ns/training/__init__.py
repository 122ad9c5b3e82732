"""Training: phases, losses, optimiser, trainer."""
