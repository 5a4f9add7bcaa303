"""Shapes of effects: what each adds over its argument, where the data were."""
