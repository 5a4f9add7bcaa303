"""The functions of FMI 2.0 and 3.0, and the effects, as compiled loops call them."""
