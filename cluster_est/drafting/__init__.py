"""A first config for an FMU and measured tables: what `cluster-est init` writes."""

from cluster_est.drafting.draft import ConfigDraft, draft, read_mapping
from cluster_est.drafting.experiment_lines import ConfigText, write

__all__ = ["ConfigDraft", "ConfigText", "draft", "read_mapping", "write"]
