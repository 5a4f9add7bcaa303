"""The worker's side of cluster-est.

It answers one question: for these values, this experiment and this model, what are the outputs
and the residuals? Users import `cluster_est`; nothing here is public.
"""
