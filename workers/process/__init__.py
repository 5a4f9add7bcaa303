"""FMUs in separate processes, which may crash, hang or leak memory."""
