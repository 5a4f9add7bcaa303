"""Pattern searches, synchronous and asynchronous."""
