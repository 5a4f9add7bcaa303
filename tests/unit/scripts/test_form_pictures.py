"""The picture of the forms in the docs is what the library's equations draw."""

import re

import numpy as np
import pytest
from docs.form_pictures import FACTORS, OUT, evaluated, picture

from workers.effects.forms import FORMS

POINT = re.compile(r"-?\d+\.\d+")


def test_the_picture_is_that_of_the_forms_today():
    shown, drawn = OUT.read_text(encoding="utf-8"), picture()
    assert POINT.sub("#", shown) == POINT.sub("#", drawn)
    numbers = [[float(n) for n in POINT.findall(text)] for text in (shown, drawn)]
    assert numbers[0] == pytest.approx(numbers[1], abs=0.2)


def test_an_equation_is_drawn_as_it_stands():
    """A factor of a parameter of 1 that falls to 0.1 far from the middle."""
    v = np.array([-1.0, 0.0, 0.3])
    found = evaluated(FORMS["parameter", "hill"], FACTORS["hill"], (v, np.ones(3), v, v))
    assert found == pytest.approx([1.0 - 0.9 / 1.09, 1.0, 0.55])
