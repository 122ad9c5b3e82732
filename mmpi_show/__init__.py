"""Baked scenes: the web page that plays them, splats, and their renderer."""
