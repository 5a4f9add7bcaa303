"""The findings of a search for missing effects: verdict, effects, curves, tables, config blocks."""
