"""A trained model for others: baked scenes, a page that flies through them, splats."""
