"""From rays to pictures: sampling and merging, windows on disk, image metrics."""
