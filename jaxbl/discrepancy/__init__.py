"""What a measured log says that a model does not: residual torques, and where they live."""
