"""What the images of a capture tell beside their colours: tracks, depths with errors, exposure, masks, new views."""
