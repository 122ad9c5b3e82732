"""Small helpers that know nothing of scenes: files, messages, keyed random draws."""
