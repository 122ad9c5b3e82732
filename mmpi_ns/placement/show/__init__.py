"""Words and pictures about a plan, for mmpi-plan."""
