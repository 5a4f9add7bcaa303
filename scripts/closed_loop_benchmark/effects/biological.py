"""Effects for the drug in the body and the chemostat, from textbooks of both fields.

Saturating elimination, induction, binding and recirculation after M. Rowland, T. N. Tozer, Clinical
Pharmacokinetics and Pharmacodynamics; inhibition after J. S. Andrews, Biotechnol. Bioeng. 10 (1968)
707-723, doi:10.1002/bit.260100602; maintenance after S. J. Pirt, Proc. R. Soc. B 163 (1965)
224-231, doi:10.1098/rspb.1965.0069.
"""

from __future__ import annotations

from closed_loop_benchmark.effect import Effect

DAY = 1.0 / 86400.0

TEXTBOOK: dict[str, tuple[Effect, ...]] = {
    "pharmacokinetics": (
        Effect("saturable_elimination", "saturating", "der(central)", (-6e-3, 40.0), "central"),
        Effect("self_inhibition", "saturating", "parameter k_e", (-0.5, 80.0), "central"),
        Effect("induction", "drift", "parameter k_e", (5e-6, 72000.0)),
        Effect("clock", "periodic_time", "parameter k_e", (0.3, DAY, 0.5)),
        Effect("protein_binding", "saturating_square", "parameter k_12", (1.5, 60.0), "central"),
        Effect("lag_time", "delay", "input oral", (1500.0,)),
        Effect("stomach", "lag", "input oral", (2500.0,)),
        Effect("first_pass", "gain", "input oral", (-0.25,)),
        Effect("blocked_pump", "saturation", "input infusion", (0.012,)),
        Effect(
            "transporter",
            "saturating",
            "pair gut,central",
            (-0.012, 30.0),
            "gut",
            weights=(1.0, -1.0),
        ),
        Effect("tissue_metabolism", "linear", "der(tissue)", (-1.5e-5,), "tissue"),
        Effect(
            "recirculation",
            "lagged",
            "der(gut)",
            (3e-5, 9000.0),
            "central",
        ),
        Effect("assay_saturates", "saturating", "output plasma_level", (0.06,)),
        Effect("sampling_line", "delay", "output plasma_level", (900.0,)),
        Effect("assay_blank", "bias", "output tissue_level", (0.15,)),
    ),
    "chemostat": (
        Effect("substrate_inhibits", "haldane", "parameter mu_max", (1.0, 0.4, 12.0), "S"),
        Effect("oxygen_limit", "saturating", "parameter mu_max", (-0.3, 3.0), "X"),
        Effect("crowding", "linear", "parameter mu_max", (-0.06, 3.0), "X"),
        Effect("warm_days", "periodic_time", "parameter mu_max", (0.12, DAY, 1.0)),
        Effect("mutants", "drift", "parameter mu_max", (1.5e-6, 72000.0)),
        Effect("maintenance", "linear", "der(S)", (-1.2e-5,), "X"),
        Effect("decay", "linear", "der(X)", (-8e-6,), "X"),
        Effect("wall_growth", "constant", "der(X)", (1.2e-5,)),
        Effect("yield_falls", "linear", "parameter yield", (-0.06, 1.5), "S"),
        Effect("grazing", "saturating", "der(X)", (-3e-5, 1.0), "X"),
        Effect("feed_line", "lag", "input S_in", (4000.0,)),
        Effect("slipping_pump", "saturation", "input D", (7e-5,)),
        Effect("leaking_valve", "bias", "input D", (5e-6,)),
        Effect("optical_density", "square", "output biomass", (-0.03,)),
        Effect("enzyme_probe", "saturating", "output substrate", (0.1,)),
        Effect("probe_lag", "lag", "output substrate", (1200.0,)),
    ),
}
