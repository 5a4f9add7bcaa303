"""The simulation part of cluster-est, which runs in workers.

Given parameter values, an experiment and a model, it computes the outputs and the residuals. Users
import `cluster_est`; nothing here is public.
"""
