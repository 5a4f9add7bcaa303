"""The findings of a closed loop: verdict, effects, curves, tables, a block for a config."""
