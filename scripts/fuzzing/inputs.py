"""Inputs of all kinds."""

from __future__ import annotations

from hypothesis import strategies as st

from fuzzing.configs import configs
from fuzzing.fmus import archives, descriptions
from fuzzing.tables import tables

INPUTS = st.one_of(configs(), configs(), tables(), descriptions(), archives())
