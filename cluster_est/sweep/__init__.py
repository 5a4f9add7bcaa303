"""Many runs from one file, started again where they stopped."""
