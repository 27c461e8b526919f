"""Diagnosis of a machine: each part is tried, and what does not work comes with the line that mends it."""

from sw_doctor.diagnosis import Diagnosis, examine

__all__ = ["Diagnosis", "examine"]
