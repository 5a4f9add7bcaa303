"""What comes before a fit: checks of an FMU and a config, and the draft of a first config.

`all_checks.run_checks` runs the checks. A check is a function of a `CheckSubject` that returns
`CheckFinding`s, and an entry in `CHECKS`; it asks the FMU with an `FmuProbe` of `workers`.
"""
