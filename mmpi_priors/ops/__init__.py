"""Inner loops that only priors need: definition in torch and C++, one folder each."""
