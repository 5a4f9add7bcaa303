"""A benchmark for finding effects that an FMU lacks, with a truth that is never the FMU."""
