"""The systems that the paper compares with, each a model of its own (`avatar.gaussians.avatar.Avatar`)."""
