"""Trials of FMUs from elsewhere: check, curve and fit of each, in processes of their own."""
