"""Inputs that are nearly valid: what fuzz.py and the test of the same name hand to the commands."""
