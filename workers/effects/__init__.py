"""Effects: terms that a model lacks, declared once as equations and added around the FMU."""
