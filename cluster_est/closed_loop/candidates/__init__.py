"""Every effect that could be missing on this data: forms, sites, arguments, scales."""
