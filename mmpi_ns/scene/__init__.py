"""What a scene is made of: the plan with its windows, MPI geometry, texels and bricks. No nerfstudio."""
