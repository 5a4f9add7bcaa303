"""The simplex search of Nelder and Mead, and its case of one unknown."""
