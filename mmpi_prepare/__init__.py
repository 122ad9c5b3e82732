"""Stages of ``mmpi-prepare``, from images or a video to a scene."""
