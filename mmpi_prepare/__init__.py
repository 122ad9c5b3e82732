"""From images or a video to a scene: what ``mmpi-prepare`` runs, stage by stage."""
