"""Priors from the training images: tracks, depths with errors, exposures, masks of moving objects, rays of new
views."""
