"""Compares every candidate with the residual to first order, without a fit."""
