"""What a design has found: the evidence and precision to expect, as rows, sentences and tables."""
