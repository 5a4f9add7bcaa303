"""Every candidate compared with the residual to first order, without a fit."""
