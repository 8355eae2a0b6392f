"""Avatars in other programs' forms: a page that any browser opens, Gaussians for viewers, meshes, videos."""
