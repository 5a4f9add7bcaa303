"""An FMU in a process of its own, which may crash, hang or leak."""
