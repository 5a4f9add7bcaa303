"""Profile likelihoods: intervals by refits."""
