"""Data structures of a scene: the plan with its windows, MPI geometry, texels and bricks. No nerfstudio."""
