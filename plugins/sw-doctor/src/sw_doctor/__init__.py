"""What works on this machine, found out by trying it, and the line that mends what does not."""

from sw_doctor.check import Check, State
from sw_doctor.diagnosis import Diagnosis, examine

__all__ = ["Check", "Diagnosis", "State", "examine"]
