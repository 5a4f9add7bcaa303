"""Effects: terms that a model lacks, declared once as equations and added around the FMU."""

from __future__ import annotations

from workers.effects.forms import FORMS, form

__all__ = ["FORMS", "form"]
