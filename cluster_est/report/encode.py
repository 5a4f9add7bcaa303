"""Numbers and texts inside an HTML page: nothing in them can end where they stand."""

from __future__ import annotations

import base64
import json
import math
from typing import Any

import numpy as np

from workers.messages import FloatArray

_HARMLESS = {
    "<": "\\u003c",
    ">": "\\u003e",
    "&": "\\u0026",
    "\u2028": "\\u2028",
    "\u2029": "\\u2029",
}


def floats(values: FloatArray) -> dict[str, Any]:
    """A curve: its centre, and what it differs from that in 32 bits each.

    So a small movement of a large number keeps its digits: the error is below 1e-7 of the range.
    """
    known = values[np.isfinite(values)]
    offset = float(0.5 * (known.min() + known.max())) if len(known) else 0.0
    raw = (values - offset).astype("<f4").tobytes()
    return {"f4": base64.b64encode(raw).decode(), "offset": offset}


def doubles(values: FloatArray) -> dict[str, Any]:
    """Times, exactly."""
    return {"f8": base64.b64encode(values.astype("<f8").tobytes()).decode()}


def short(values: FloatArray) -> list[float | None]:
    """A few numbers, to seven digits; null for what is not finite."""
    return [float(f"{v:.7g}") if math.isfinite(v) else None for v in values.tolist()]


def json_text(value: Any) -> str:
    """JSON that may stand inside a script element.

    Raises
    ------
    ValueError
        If there is a number in it that JSON does not have.
    """
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    for sign, code in _HARMLESS.items():
        text = text.replace(sign, code)
    return text
