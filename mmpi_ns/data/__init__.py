"""From a folder to batches of rays: data set, data manager, rays, checks of a scene."""
