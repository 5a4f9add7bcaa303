"""Laws: the mathematical relation between the variables of an effect and its term."""

from __future__ import annotations

import enum


class Law(enum.Enum):
    """The law of a form. Its text names the effect if the units give no physical name.

    {v} and {w} are the form's variables, and {s} is the signal at the site. At a parameter, the law
    describes the relative change of the parameter (the text then says "a variation"). For an
    inverse, it describes the divisor of the parameter.
    """

    CONSTANT = "a constant term"
    DRIFT = "a drift in time"
    WAVE = "a sinusoid in time"
    LINEAR = "a term linear in {v}"
    ABSOLUTE = "a term proportional to the magnitude of {v}"
    SQUARE = "a term quadratic in {v}"
    ODD_SQUARE = "a term quadratic in {v} with the sign of {v}"
    CUBE = "a term cubic in {v}"
    FOURTH_DIFFERENCE = "a term in the difference of the fourth powers of {v} and {w}"
    INVERSE = "a term in the inverse of {v}"
    INVERSE_SQUARE = "a term in the inverse square of {v}"
    ROOT = "a term in the square root of {v}"
    ODD_ROOT = "a term in the square root of {v} with the sign of {v}"
    POWER = "a power law in {v}"
    OFFSET_POWER = "a power law in {v} with an offset"
    ABOVE_BY_POWER = "a power law in {v} above a threshold"
    EXPONENTIAL = "a term exponential in {v}"
    SWITCH = "a term that switches with the sign of {v}"
    SWITCH_WITH_PEAK = "a term that switches with the sign of {v}, with a peak near zero"
    TWO_SWITCHES = "a term that switches with the sign of {v} between two levels"
    SWITCH_BY_MAGNITUDE = (
        "a term that switches with the sign of {v}, proportional to the magnitude of {w}"
    )
    SWITCH_BY_CURVE = (
        "a term that switches with the sign of {v} and whose magnitude is a free curve of {w}"
    )
    HYSTERESIS = "a hysteresis over {v}"
    ABOVE = "a term linear in {v} above a threshold"
    BELOW = "a term linear in {v} below a threshold"
    GAP = "a term linear in {v} beyond a gap"
    CLIPPED = "a term linear in {v} up to a limit"
    SATURATING = "a term that saturates in {v}"
    HILL = "a term that saturates in the square of {v}"
    HILL_POWER = "a term that saturates in a power of {v}"
    ARRHENIUS = "a term in {v} that follows the Arrhenius law"
    PERIODIC = "a term periodic in {v}"
    PERIODIC_TRAVEL = "a term periodic in the integral of {v}"
    PRODUCT = "a product of {v} and {w}"
    PRODUCT_OF_POWERS = "a product of powers of {v} and {w}"
    TIMES_POWER = "an exchange driven by {v} that grows with a power of {w}"
    LAGGED = "a term in the lagged {v}"
    DELAYED = "a term in the delayed {v}"
    TWO_LAGS = "a term in {v} with two hidden time constants"
    LAGGED_SQUARE = "a term in the lagged square of {v}"
    STORE = "an exchange with a hidden store that lags behind {v}"
    STORE_FROM_ZERO = "an exchange with a hidden store that lags behind {v} and starts at zero"
    STORE_FROM_ELSEWHERE = (
        "an exchange with a hidden store that lags behind {v} and has an estimated start value"
    )
    TWO_STORES = "an exchange with two hidden stores that lag behind {v}"
    TWO_STORES_FROM_ZERO = (
        "an exchange with two hidden stores that lag behind {v} and start at zero"
    )
    STORE_BETWEEN = "a hidden store between {v} and {w}"
    DECAY = "a term that decays from the start of the record"
    ATTACHED_OSCILLATOR = "a hidden oscillator attached to {v}"
    RESONANCE = "a hidden oscillator driven by {v}"
    CURVE = "a free curve of {v}"
    DYNAMICS = "hidden dynamics from {v}"
    EXCHANGE = "hidden dynamics of what {v} exchanges"
    OTHER = "a term in {v}"
    """The law of a user's equation and of process noise; a search tries neither."""

    # changes of an input or output signal
    OFFSET = "an offset"
    GAIN = "a different gain"
    GAIN_OF_MAGNITUDE = "a part proportional to the magnitude"
    ASYMMETRY = "a different gain for positive values"
    QUADRATIC_PART = "a quadratic part"
    CUBIC_PART = "a cubic part"
    PRODUCT_WITH_SIGNAL = "a product of {s} and {v}"
    POWER_CHARACTERISTIC = "a power law"
    LEVELLING = "a characteristic that levels off"
    CHARACTERISTIC = "a curved characteristic"
    DEAD_ZONE = "a dead zone"
    CUT_OFF = "a cut-off of small values"
    PERIODIC_ERROR = "a part that is periodic in the signal"
    BACKLASH = "backlash"
    HYSTERESIS_OF_SIGNAL = "a hysteresis"
    RATE_LIMIT = "a rate limit"
    RATE_LIMIT_FROM_REST = "a rate limit, from a start at zero"
    SATURATION = "saturation on both sides"
    LIMIT_ABOVE = "an upper limit"
    LIMIT_BELOW = "a lower limit"
    FIRST_ORDER_LAG = "a first-order lag"
    FIRST_ORDER_LAG_FROM_ZERO = "a first-order lag that starts at zero"
    LEAD = "a lead or a partial first-order lag"
    SECOND_ORDER_LAG = "a second-order lag"
    SECOND_ORDER_LAG_FROM_ZERO = "a second-order lag that starts at zero"
    DELAY = "a delay"
    SIGNAL_DYNAMICS = "hidden dynamics of the signal"
