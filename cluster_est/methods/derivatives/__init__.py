"""Jacobians and gradients of a cost: by finite differences or from the model."""
