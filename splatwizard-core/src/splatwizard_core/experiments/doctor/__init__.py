"""What works on this machine, found out by trying it, and the line that mends what does not."""

from splatwizard_core.experiments.doctor.check import Check, State
from splatwizard_core.experiments.doctor.diagnosis import Diagnosis, examine

__all__ = ["Check", "Diagnosis", "State", "examine"]
