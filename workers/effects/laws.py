"""Laws: how what an effect adds depends on its variables, in the words of mathematics."""

from __future__ import annotations

import enum


class Law(enum.Enum):
    """The law of a form. A member's text is its name where units do not say what physics would.

    {v} and {w} are the form's variables, {s} is the signal at the site. At a parameter the law is
    that of the share by which it changes, "a variation" there, or of its divisor for an inverse.
    """

    CONSTANT = "a constant term"
    DRIFT = "a drift in time"
    WAVE = "a sinusoid in time"
    LINEAR = "a term linear in {v}"
    ABSOLUTE = "a term proportional to the magnitude of {v}"
    SQUARE = "a term quadratic in {v}"
    ODD_SQUARE = "a term quadratic in {v} that has its sign"
    CUBE = "a term cubic in {v}"
    FOURTH_DIFFERENCE = "a term in the difference of the fourth powers of {v} and {w}"
    INVERSE = "a term inverse in {v}"
    INVERSE_SQUARE = "a term inverse in the square of {v}"
    ROOT = "a term in the square root of {v}"
    ODD_ROOT = "a term in the square root of {v} that has its sign"
    POWER = "a power law in {v}"
    ABOVE_BY_POWER = "a power law in {v} above a threshold"
    EXPONENTIAL = "a term exponential in {v}"
    SWITCH = "a term that switches with the sign of {v}"
    SWITCH_WITH_PEAK = "a term that switches with the sign of {v}, with a peak near zero"
    TWO_SWITCHES = "a term that switches with the sign of {v} between two levels"
    SWITCH_BY_MAGNITUDE = (
        "a term that switches with the sign of {v}, proportional to the magnitude of {w}"
    )
    SWITCH_BY_CURVE = (
        "a term that switches with the sign of {v} and has the size of a free curve of {w}"
    )
    HYSTERESIS = "a hysteresis over {v}"
    ABOVE = "a term linear in {v} above a threshold"
    BELOW = "a term linear in {v} below a threshold"
    GAP = "a term linear in {v} beyond a gap"
    CLIPPED = "a term linear in {v} up to a limit"
    SATURATING = "a term that saturates in {v}"
    HILL = "a term that saturates in the square of {v}"
    HILL_POWER = "a term that saturates in a power of {v}"
    ARRHENIUS = "a term by the law of Arrhenius in {v}"
    PERIODIC = "a term periodic in {v}"
    PERIODIC_TRAVEL = "a term periodic in the integral of {v}"
    PRODUCT = "a product of {v} and {w}"
    PRODUCT_OF_POWERS = "a product of powers of {v} and {w}"
    LAGGED = "a term in the lagged {v}"
    DELAYED = "a term in the delayed {v}"
    LAGGED_SQUARE = "a term in the lagged square of {v}"
    STORE = "an exchange with a hidden store that follows {v}"
    STORE_FROM_ZERO = "an exchange with a hidden store that follows {v} and begins at zero"
    STORE_FROM_ELSEWHERE = "an exchange with a hidden store that follows {v} and begins elsewhere"
    TWO_STORES = "an exchange with two hidden stores that follow {v}"
    TWO_STORES_FROM_ZERO = "an exchange with two hidden stores that follow {v} and begin at zero"
    STORE_BETWEEN = "a hidden store between {v} and {w}"
    DECAY = "a term that decays from the start on"
    ATTACHED_OSCILLATOR = "a hidden oscillator attached to {v}"
    RESONANCE = "a hidden oscillator that {v} drives"
    CURVE = "a free curve of {v}"
    OTHER = "a term in {v}"
    """Of an equation that a user wrote, or of process noise; a search tries neither."""

    # what an input or an output does to its own signal
    OFFSET = "an offset"
    GAIN = "another gain"
    GAIN_OF_MAGNITUDE = "another gain for the magnitude"
    ASYMMETRY = "another gain for positive values"
    QUADRATIC_PART = "a quadratic part"
    CUBIC_PART = "a cubic part"
    PRODUCT_WITH_SIGNAL = "a product of {s} and {v}"
    POWER_CHARACTERISTIC = "a power law"
    LEVELLING = "a characteristic that levels off"
    CHARACTERISTIC = "a curved characteristic"
    DEAD_ZONE = "a dead zone"
    CUT_OFF = "a cut-off of small values"
    PERIODIC_ERROR = "a part periodic in the signal"
    BACKLASH = "backlash"
    RATE_LIMIT = "a limit of the rate"
    RATE_LIMIT_FROM_REST = "a limit of the rate, from zero on"
    SATURATION = "saturation on both sides"
    LIMIT_ABOVE = "a limit from above"
    LIMIT_BELOW = "a limit from below"
    FIRST_ORDER_LAG = "a lag of first order"
    FIRST_ORDER_LAG_FROM_ZERO = "a lag of first order that begins at zero"
    LEAD = "a lead or a partial lag of first order"
    SECOND_ORDER_LAG = "a lag of second order"
    SECOND_ORDER_LAG_FROM_ZERO = "a lag of second order that begins at zero"
    DELAY = "a delay"
