"""From rays to images: sampling and merging, windows on disk, image metrics."""
