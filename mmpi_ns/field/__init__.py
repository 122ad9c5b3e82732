"""The radiance field: tables of texels, densities, colours and reliability."""
