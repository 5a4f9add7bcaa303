"""What a model lacks: detect, locate, name, add, refit, and the errors before and after.

Read `loop.py` first.
"""
