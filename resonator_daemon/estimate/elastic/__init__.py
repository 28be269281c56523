"""Linear elasticity of a half-space in the domain of spatial frequency: pure arrays, no I/O."""
