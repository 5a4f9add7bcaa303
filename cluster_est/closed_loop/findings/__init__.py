"""What a closed loop says in the end: verdict, effects, curves, tables, a block for a config."""
