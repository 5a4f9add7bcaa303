"""The league: measured cases, each with a base model and the effect that a textbook adds to it."""
