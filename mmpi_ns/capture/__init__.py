"""Everything read from a capture: images, rays, SfM tracks and depths, and checks of the input."""
