"""Helpers independent of scenes: files, messages, keyed random draws."""
