"""Export of trained models: baked scenes, a web page for them, splats."""
