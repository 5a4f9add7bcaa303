"""A first config for an FMU and measured tables: what `cluster-est init` writes."""

from cluster_est.drafting.draft import Draft, draft
from cluster_est.drafting.mismatches import unit_mismatches
from cluster_est.drafting.writing import Text, write

__all__ = ["Draft", "Text", "draft", "unit_mismatches", "write"]
