"""Every waveform by its name; a new one is a file beside these and a line here."""

from __future__ import annotations

from cluster_est.experiment_design.waveforms.base import LEVELS, Waveform, WaveformGrid, within_rate
from cluster_est.experiment_design.waveforms.multisine import Multisine
from cluster_est.experiment_design.waveforms.prbs import BinarySequence
from cluster_est.experiment_design.waveforms.ramps import Ramps
from cluster_est.experiment_design.waveforms.spline import Spline
from cluster_est.experiment_design.waveforms.steps import Steps

WAVEFORMS: dict[str, Waveform] = {
    waveform.name: waveform
    for waveform in (Steps(), Ramps(), Multisine(), BinarySequence(), Spline())
}

__all__ = ["LEVELS", "WAVEFORMS", "Waveform", "WaveformGrid", "within_rate"]
