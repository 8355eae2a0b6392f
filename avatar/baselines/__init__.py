"""The systems that the paper compares with, each a model of its own (`avatar.gaussians.base_model.Avatar`)."""
