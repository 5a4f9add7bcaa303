"""Preflight: checks of an FMU and a config before a fit, and the draft of a first config.

`all_checks.run_checks` runs the checks. A check is a function of a `CheckSubject` that returns
`CheckFinding`s, with an entry in `CHECKS`; it calls the FMU through an `FmuProbe` of `workers`.
"""
