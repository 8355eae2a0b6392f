"""Gaussian Head Avatar: a head of free Gaussians with feature colours that a network draws at a larger size."""
