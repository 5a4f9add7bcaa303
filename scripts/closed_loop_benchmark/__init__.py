"""A benchmark for finding effects that an FMU lacks; the true system is never the FMU itself."""
