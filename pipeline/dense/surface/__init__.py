"""From depth maps to one closed surface: a signed distance on a sparse grid, its net, vertices drawn to the views."""
