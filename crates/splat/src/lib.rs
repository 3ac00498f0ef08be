//! Gaussians, projection, tiles, the underwater compositor and its exact backward, the linear splat and its adjoint, PLY
